"""Rotation without depth: the grid over SO(3), the global search, its refinement, and the fit to bearings."""

import math

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.data.synthetic import make_world
from torchvo360.data.synthetic.motion import trajectory
from torchvo360.image import blur, resample
from torchvo360.motion.rotation import align_rotation, fit_rotation, rotation_grid, search_rotation
from torchvo360.residuals.direct import Reference, Target, make_target
from torchvo360.vo.recover import GRID_STEP_RAD

SMALL = Equirectangular(64, 32)
LARGE = Equirectangular(128, 64)


def random_rotations(count: int, seed: int) -> Tensor:
    q = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return lie.matrix_from_quaternion(q / q.norm(dim=-1, keepdim=True))


@pytest.mark.parametrize("step", [0.3, GRID_STEP_RAD, 0.6, 1.0])
def test_every_rotation_is_within_a_step_of_the_grid(step):
    grid = rotation_grid(step)
    torch.testing.assert_close(grid @ grid.mT, torch.eye(3, dtype=torch.float64).expand_as(grid))
    trace = torch.einsum("nij,mij->nm", random_rotations(3000, 0), grid).amax(1)
    distance = ((trace - 1) / 2).clamp(-1, 1).acos()
    assert float(distance.max()) < 0.95 * step
    assert float(distance.median()) > 0.3 * step, "else the grid wastes time"


def views(world: str, seed: int, R_tgt_ref: Tensor) -> list[Tensor]:
    """Grey 64 x 32 panoramas of one place, the first unrotated, the others turned."""
    scene = make_world(world, seed=seed)
    pose = trajectory("still", scene.walkway, 1, 30.0, seed=seed)[0]
    turned = pose @ lie.se3(R_tgt_ref.mT, torch.zeros(len(R_tgt_ref), 3, dtype=torch.float64))
    images = scene.render(LARGE, torch.cat([pose[None], turned]))[0].mean(1)
    return [blur(resample(image, SMALL), SMALL, 1.0) for image in images]


def reference(image: Tensor) -> Reference:
    area = SMALL.solid_angle(SMALL.pixel_grid())
    zeros = torch.zeros(1, 64 * 32)
    ray = SMALL.ray_grid().permute(2, 0, 1).reshape(1, 3, -1).contiguous()
    return Reference(ray, zeros, image.reshape(1, 1, -1), (area / area.mean()).reshape(1, -1))


def target(image: Tensor) -> Target:
    return make_target(image[None, None], SMALL)


def errors_deg(R: Tensor, true: Tensor) -> Tensor:
    return lie.so3_angle(R @ true.mT).rad2deg()


@pytest.mark.parametrize(("world", "seed"), [("room", 0), ("courtyard", 1)])
def test_twenty_four_of_twenty_four_random_rotations_are_found_under_another_exposure(world, seed):
    true = random_rotations(24, seed)
    first, *others = views(world, seed, true)
    grid = rotation_grid(GRID_STEP_RAD)
    error, agreement, affine = [], [], torch.zeros(2)
    for R, image in zip(true, others, strict=True):
        result = search_rotation(reference(first), target(image * 0.55 + 0.1), grid)
        error.append(float(errors_deg(result.R_tgt_ref[0], R)))
        agreement.append(float(result.agreement[0]))
        affine = result.affine[0]
        torch.testing.assert_close(result.cost, result.cost.sort().values, rtol=0, atol=0)
    assert max(error) < 1.0, error
    assert min(agreement) > 0.6
    assert float(affine[0]) == pytest.approx(math.log(0.55), abs=0.1)
    assert float(affine[1]) == pytest.approx(0.1, abs=0.05)


def test_an_unrelated_panorama_does_not_agree():
    eye = torch.eye(3, dtype=torch.float64)[None]
    room, courtyard = views("room", 0, eye)[0], views("courtyard", 1, eye)[0]
    result = search_rotation(reference(room), target(courtyard), rotation_grid(GRID_STEP_RAD))
    assert float(result.agreement.max()) < 0.4


def test_pixels_without_weight_do_not_count():
    true = random_rotations(4, 3)
    first, *others = views("room", 2, true)
    points = reference(first)
    below = points.ray[:, 1] > 0.5
    noise = torch.rand(1, 1, 2048, generator=torch.Generator().manual_seed(0))
    spoiled = torch.where(below[:, None], noise, points.value)
    masked = Reference(points.ray, points.rho, spoiled, points.weight * ~below)
    for R, image in zip(true, others, strict=True):
        result = search_rotation(masked, target(image), rotation_grid(GRID_STEP_RAD))
        assert float(errors_deg(result.R_tgt_ref[0], R)) < 1.0


def test_the_refinement_converges_from_25_degrees_about_any_axis():
    g = torch.Generator().manual_seed(0)
    axis = torch.randn(12, 3, generator=g, dtype=torch.float64)
    true = lie.so3_exp(axis / axis.norm(dim=-1, keepdim=True) * math.radians(25))
    first, *others = views("room", 0, true)
    eye = torch.eye(3, dtype=torch.float64)[None]
    error = [
        float(errors_deg(align_rotation(reference(first), target(image), eye).R_tgt_ref[0], R))
        for R, image in zip(true, others, strict=True)
    ]
    assert sum(e < 0.5 for e in error) >= 11, error


def test_starts_do_not_disturb_each_other():
    true = random_rotations(1, 5)
    first, image = views("room", 0, true)
    near = lie.so3_exp(torch.tensor([0.1, -0.1, 0.05], dtype=torch.float64)) @ true[0]
    alone = align_rotation(reference(first), target(image), near[None])
    among = align_rotation(reference(first), target(image), torch.stack([*random_rotations(3, 6), near]))
    assert float(errors_deg(among.R_tgt_ref[0], true[0])) < 0.5, "the best comes first"
    torch.testing.assert_close(among.R_tgt_ref[0], alone.R_tgt_ref[0], rtol=0, atol=1e-4)


def test_a_blank_image_gives_finite_rotations_without_agreement():
    first, image = views("room", 0, torch.eye(3, dtype=torch.float64)[None])
    for a, b in ((first, torch.zeros_like(image)), (torch.zeros_like(first), image)):
        result = search_rotation(reference(a), target(b), rotation_grid(0.6))
        assert bool(result.R_tgt_ref.isfinite().all())
        assert float(result.agreement.max()) < 0.05


# Bearings


def bearing_pairs(R: Tensor, *, outliers: float, noise: float = 1e-3) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    ref = torch.randn(400, 3, generator=g, dtype=torch.float64)
    ref = ref / ref.norm(dim=-1, keepdim=True)
    tgt = ref @ R.mT + noise * torch.randn(400, 3, generator=g, dtype=torch.float64)
    wrong = ref @ R.mT + 0.3 * torch.randn(400, 3, generator=g, dtype=torch.float64)
    tgt = torch.where(torch.rand(400, 1, generator=g) < outliers, wrong, tgt)
    return ref, tgt / tgt.norm(dim=-1, keepdim=True)


def test_exact_bearings_give_the_exact_rotation():
    R = random_rotations(1, 7)[0]
    ref, tgt = bearing_pairs(R, outliers=0.0, noise=0.0)
    torch.testing.assert_close(fit_rotation(ref, tgt, torch.eye(3, dtype=torch.float64)), R)


@pytest.mark.parametrize("angle_deg", [0.0, 10.0, 60.0])
def test_forty_percent_of_outliers_do_not_turn_the_fit(angle_deg):
    R = lie.so3_exp(torch.tensor([0.6, -0.6, 0.53], dtype=torch.float64) * math.radians(angle_deg))
    ref, tgt = bearing_pairs(R, outliers=0.4)
    fitted = fit_rotation(ref, tgt, torch.eye(3, dtype=torch.float64))
    assert float(errors_deg(fitted, R)) < 0.05
    assert float(torch.linalg.det(fitted)) == pytest.approx(1.0)
