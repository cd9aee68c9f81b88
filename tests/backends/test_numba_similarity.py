"""Loops' compiled solves end where the ones in steps of torch do."""

import math
from dataclasses import replace

import pytest
import torch

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.image import pad_image
from torchvo360.loop import similarity
from torchvo360.loop.config import VerifyConfig
from torchvo360.loop.ranges import NEAR_RAD, SLOPE, pair_ranges
from torchvo360.loop.similarity import LevelPair, linearize_similarity, solve_similarity
from torchvo360.motion import rotation
from torchvo360.motion.rotation import rotation_grid
from torchvo360.residuals.direct import Reference, Target
from torchvo360.solve import LMConfig, Solution, Status

similarities = pytest.importorskip("torchvo360.backends.numba.kernels.similarities")
neighbours = pytest.importorskip("torchvo360.backends.numba.kernels.neighbours")

FULL, PARTIAL = Equirectangular(64, 32), Equirectangular(64, 24, fy=32 / math.pi)
TANGENTS = [[0.0] * 7, [1e-9] * 7, [0.3, -0.2, 0.5, 0.4, -0.7, 0.2, 0.3], [3.0, -3.0, 3.0, 3.0, 3.0, -3.0, -3.0]]


def random_pair(seed: int, *, masked: bool = False, camera: Equirectangular = FULL) -> LevelPair:
    """A smooth image on a shell that ranges of 1 to 3 make uneven, seen from one place twice."""
    generator = torch.Generator().manual_seed(seed)
    waves, phase = torch.randn(12, 3, generator=generator) * 2, torch.rand(12, generator=generator) * 6

    def look(ray):
        return 0.5 + 0.08 * torch.sin(waves @ ray + phase[:, None]).sum(0)

    def frame(count):
        grid = camera.ray_grid().view(-1, 3).T
        image = look(grid).view(1, 1, camera.height, camera.width)
        known = (torch.arange(camera.height) < 0.7 * camera.height)[:, None].expand(image.shape).float()
        confidence = pad_image(known, camera, 1).contiguous() if masked else None
        target = Target(camera, pad_image(image, camera, 1).contiguous(), confidence, 0.95)
        ray = torch.randn(3, count, generator=generator)
        ray = ray / ray.norm(dim=0)
        rho = 1 / (2 + torch.sin(3 * ray[0]) * 0.9)
        noise = 1 + 0.05 * torch.randn(count, generator=generator)
        return target, Reference(
            ray[None],
            (rho * noise)[None],
            look(ray)[None, None],
            torch.ones(1, count),
            (0.05 * rho).square()[None],
        )

    (image_a, points_a), (image_b, points_b) = frame(700), frame(650)
    return LevelPair(points_a, points_b, image_a, image_b, 300)


def starts(count: int, size: float, seed: int = 0) -> torch.Tensor:
    return lie.sim3_exp(size * torch.randn(count, 7, generator=torch.Generator().manual_seed(seed)).double())


def solved(pair: LevelPair, S: torch.Tensor, max_steps: int, coarsest: bool) -> tuple[Solution, Solution]:
    config = VerifyConfig(solver=LMConfig(cost_tolerance=1e-4)).align_config(coarsest=coarsest)
    affine = 0.05 * torch.randn(len(S), 4, generator=torch.Generator().manual_seed(3)).double()
    found = solve_similarity(pair, S, affine, config, max_steps)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(similarity, "_serves", lambda *_: False)
        return found, solve_similarity(pair, S, affine, config, max_steps)


@pytest.mark.parametrize("coarsest", [False, True])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("max_steps", [1, 2, 12])
def test_similarities_end_as_in_steps_of_torch(masked, coarsest, max_steps):
    found, truth = solved(random_pair(0, masked=masked), starts(4, 0.05), max_steps, coarsest)
    assert found.status.tolist() == truth.status.tolist()
    assert found.steps.tolist() == truth.steps.tolist()
    for one, other in zip(found.state, truth.state, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=2e-4)
    for one, other in zip(found.equations, truth.equations, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3 * float(other.abs().max()))


def test_normal_equations_are_those_of_torch_far_from_the_solution():
    pair, S = random_pair(1), starts(5, 0.7)
    config = VerifyConfig().align_config(coarsest=False)
    affine = torch.zeros(5, 4, dtype=torch.float64)
    # A step that so much damping leaves of no length is not taken: the start's equations come back.
    config = replace(config, solver=LMConfig(initial_damping=1e30, max_damping=1e20))
    found = solve_similarity(pair, S, affine, config, 1).equations
    truth = linearize_similarity(pair, S, affine, config.loss, config.noise)
    for one, other in zip(found, truth, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))


def test_without_enough_points_there_is_no_solution():
    pair = random_pair(2)
    hidden = LevelPair(
        *(replace(points, weight=torch.zeros_like(points.weight)) for points in (pair.points_a, pair.points_b)),
        pair.image_a,
        pair.image_b,
        2,
    )
    found, truth = solved(hidden, starts(1, 0.01), 5, coarsest=False)
    assert found.status.tolist() == truth.status.tolist() == [Status.TOO_FEW_PIXELS]


@pytest.mark.parametrize("tangent", TANGENTS)
def test_exponential_inverse_and_its_step(tangent):
    xi = torch.tensor(tangent, dtype=torch.float64)
    S = lie.sim3_exp(xi)
    found = torch.from_numpy(similarities.sim3_exp(xi.numpy()))
    torch.testing.assert_close(found, S, rtol=1e-10, atol=1e-10)
    inverse, forward, backward = torch.empty(3, 4, 4, dtype=torch.float64)
    J = torch.empty(7, 7, dtype=torch.float64)
    scale = similarities.split(S.numpy(), inverse.numpy(), forward.numpy(), backward.numpy())
    similarities.step_of_inverse(inverse.numpy(), 1 / scale, J.numpy())
    S_inverse = lie.sim3_inverse(S)
    torch.testing.assert_close(inverse, S_inverse, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(J, -lie.sim3_adjoint(S_inverse), rtol=1e-9, atol=1e-9)
    for way, of in ((forward, S), (backward, S_inverse)):
        torch.testing.assert_close(way, similarity.rigid(of[None])[0][0], rtol=1e-9, atol=1e-9)


def test_neighbours_in_a_band_are_the_nearest_of_all():
    pair, S = random_pair(4), starts(1, 0.3)
    (_, _, compared, near), _ = pair.compiled
    a, b, some, _ = pair._range_points
    truth = pair_ranges(some, b, S)
    M = torch.empty(5, 5, dtype=torch.float64)
    settings = (NEAR_RAD, SLOPE, 1e-3, 3.0)
    _, count = neighbours.sum_ranges(S[0].numpy(), tuple(compared), tuple(near), settings, M.numpy())
    assert count == int((truth.weight > 0).sum()) > 100
    eye = torch.eye(4, dtype=torch.float64)
    poles = a._replace(ray=torch.tensor([[0.0, 0.0], [1.0, -1.0], [0.0, 0.0]]), rho=a.rho[:2], variance=a.variance[:2])
    compared = similarity.numba.range_arrays(*poles, ordered=False)
    _, count = neighbours.sum_ranges(eye.numpy(), tuple(compared), tuple(near), settings, M.numpy())
    assert count == int((pair_ranges(poles, b, eye[None]).weight > 0).sum())


@pytest.mark.parametrize("camera", [FULL, PARTIAL], ids=["full", "partial"])
def test_rotations_rank_as_with_torch(camera):
    pair = random_pair(5, camera=camera)
    grid = rotation_grid(0.43)
    found = rotation._correlation(pair.points_a, pair.image_b, grid)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rotation, "use_numba", lambda *_: False)
        truth = rotation._correlation(pair.points_a, pair.image_b, grid)
    torch.testing.assert_close(found.float(), truth.float(), rtol=0, atol=2e-4)


def test_refined_rotations_are_those_of_torch():
    pair = random_pair(6)
    R = lie.so3_exp(0.1 * torch.randn(4, 3, generator=torch.Generator().manual_seed(0)).double())
    found = rotation.align_rotation(pair.points_a, pair.image_b, R)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rotation.pairs, "serves", lambda *_: False)
        truth = rotation.align_rotation(pair.points_a, pair.image_b, R)
    for one, other in zip(vars(found).values(), vars(truth).values(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
