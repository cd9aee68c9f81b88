"""The compiled pass means what the eager kernel means: in every option, at hard points, whatever the threads."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends import eager, select
from torchvo360.backends.numba import linearize
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError, ShapeError
from torchvo360.residuals.direct import Reference, Target, make_target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig

pytest.importorskip("numba")

FULL = Equirectangular(128, 64)
ROLLED = Equirectangular(128, 64, cx=20.0)
PARTIAL = Equirectangular(96, 40, 128 / math.tau, -64 / math.pi, 40.0, 21.0)
PLANE = Pinhole(96, 72, 80.0, 84.0, 47.1, 36.4)
EVERY = {"full": FULL, "rolled": ROLLED, "partial": PARTIAL, "pinhole": PLANE}
CAMERAS = pytest.mark.parametrize("camera", list(EVERY.values()), ids=list(EVERY))
HUBER = LossConfig(scale=0.05)
LOSSES = [
    HUBER,
    LossConfig(name="huber", cutoff=0.08),
    LossConfig(name="student_t", cutoff=0.1),
    LossConfig(name="student_t"),
    LossConfig(name="none"),
    LossConfig(name="none", cutoff=0.05),
]
Problem = tuple[Reference, Target, Tensor, Tensor]


def smooth(camera: Camera, *batch: int, seed: int) -> Float[Tensor, "*batch H W"]:
    """Waves on the sphere, between 0 and 1."""
    generator = torch.Generator().manual_seed(seed)
    ray = torch.nn.functional.normalize(camera.ray_grid(dtype=torch.float64), dim=-1)
    wave = 4 * torch.randn(math.prod(batch), 3, generator=generator, dtype=torch.float64)
    value = torch.einsum("hwc,bc->bhw", ray, wave).sin() + torch.einsum("hwc,bc->bhw", ray, wave.roll(1, 1)).cos()
    return (0.5 + 0.24 * value).float().view(*batch, camera.height, camera.width)


def everything(camera: Camera, B: int, C: int, *, shared: bool = True) -> Problem:
    """Pairs with variances, confidences, saturation, and intrinsics and rays of their own."""
    generator = torch.Generator().manual_seed(1)
    rho = smooth(camera, B, seed=2).flatten(1)
    rho[:, ::7] = 0.0
    ray = camera.ray_grid().permute(2, 0, 1).flatten(1)[None]
    turn = lie.so3_exp(0.1 * torch.randn(B, 3, generator=generator, dtype=torch.float64)).float()
    reference = Reference(
        ray if shared else turn @ ray,
        rho,
        smooth(camera, B, C, seed=3).flatten(2),
        (0.2 + smooth(camera, 1, seed=4)).flatten(1).expand(B, -1),
        0.02 * smooth(camera, B, seed=5).flatten(1),
    )
    k = torch.tensor([camera.intrinsics]) * (1 + 0.01 * torch.randn(B, 4, generator=generator))
    if camera.wraps:
        k[:, 0] = camera.width / math.tau
    image = smooth(camera, B, C, seed=3) + 0.2 * smooth(camera, B, C, seed=6) - 0.1
    target = make_target(image, camera, 0.3 + 0.5 * smooth(camera, B, seed=7), 0.85, k)
    xi = torch.randn(B, 6, generator=generator, dtype=torch.float64) * torch.tensor([0.1] * 3 + [0.05] * 3)
    return reference, target, lie.se3_exp(xi), 0.05 * torch.randn(B, 2, generator=generator, dtype=torch.float64)


def plain(problem: Problem) -> Problem:
    """Without what may be left out."""
    reference, target, T, affine = problem
    target = replace(target, confidence=None, saturation=None, intrinsics=None)
    return replace(reference, variance=None), target, T, affine


def assert_equal(found: NormalEquations, truth: NormalEquations, H: float = 2e-5, g: float = 2e-5) -> None:
    """Hold each pair to the truth; the default leaves room for pixels that rounding puts into the next cell."""
    for k in range(len(truth.cost)):
        torch.testing.assert_close(found.H[k], truth.H[k], rtol=0, atol=H * float(truth.H[k].norm()))
        torch.testing.assert_close(found.g[k], truth.g[k], rtol=0, atol=g * float(truth.g[k].norm()))
    for name in ("cost", "weight", "square"):
        torch.testing.assert_close(getattr(found, name), getattr(truth, name), rtol=2e-5, atol=1e-12)


@CAMERAS
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: f"{loss.name} {loss.cutoff}")
@pytest.mark.parametrize(("channels", "shared"), [(1, True), (3, False)])
def test_every_option_means_what_it_means_to_the_eager_kernel(camera, loss, channels, shared):
    problem = everything(camera, 3, channels, shared=shared)
    assert_equal(linearize(*problem, loss, noise=0.02), eager.linearize(*problem, loss, noise=0.02))
    assert_equal(linearize(*plain(problem), loss), eager.linearize(*plain(problem), loss))


def lone_points(camera: Camera, points: Float[Tensor, "M 3"], rho: float) -> Problem:
    """Pairs of one point each, at the identity."""
    M = len(points)
    generator = torch.Generator().manual_seed(8)
    value, weight = torch.rand(M, 1, 1, generator=generator), torch.rand(M, 1, generator=generator) + 0.5
    reference = Reference(points[:, :, None].contiguous(), torch.full((M, 1), rho), value, weight)
    image = smooth(camera, 1, 1, seed=3).expand(M, -1, -1, -1)
    return reference, make_target(image, camera), torch.eye(4).double().repeat(M, 1, 1), torch.zeros(M, 2).double()


@CAMERAS
@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_hard_points_are_seen_and_counted_as_by_the_eager_kernel(camera, rho):
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    small = torch.tensor([1e-7, -1e-7, 1e-12, -1e-12])
    beside = [torch.stack([x, torch.ones(4), x.flip(0)], -1) for x in (small, -small)]
    seam = torch.stack([small, 0.3 * torch.ones(4), -torch.ones(4)], -1)
    width, height = camera.width, camera.height
    edges = [0.49, 0.5 + 1e-3, 0.51, 1.0, 1.5]
    u = torch.tensor([*edges, *(width - x for x in edges), width / 2, -3.0, width + 3.0])
    v = torch.tensor([*edges, *(height - x for x in edges), height / 2, 2.0, height - 2.0])
    border = camera.ray(torch.cartesian_prod(u, v))
    points = torch.cat(
        [axes, *beside, -beside[0], seam, torch.zeros(1, 3), border, -border, 1e9 * border, 1e-9 * border]
    )
    problem = lone_points(camera, points, rho)
    found, truth = linearize(*problem, HUBER), eager.linearize(*problem, HUBER)
    assert torch.equal(found.weight, truth.weight)
    # One point is beside a cell's border as often as not: slopes are compared over images above, here values.
    torch.testing.assert_close(found.cost, truth.cost, rtol=1e-4, atol=1e-7)
    assert all(torch.isfinite(part).all() for part in found)


def test_the_border_of_a_pinholes_image_is_seen_alike_to_the_last_bit():
    # At the identity the outermost pixels lie where rounding decides; so they must be rounded alike.
    reference, target, _, affine = plain(everything(PLANE, 1, 1))
    reference = replace(reference, weight=torch.ones_like(reference.weight))
    for level in range(20):
        camera = Pinhole(96, 72, 80.0 + level / 3, 84.0 - level / 7, 47.1 + level / 11, 36.4)
        points = replace(reference, ray=camera.ray_grid().permute(2, 0, 1).flatten(1)[None])
        problem = points, replace(target, camera=camera), torch.eye(4)[None].double(), affine
        assert torch.equal(linearize(*problem, HUBER).weight, eager.linearize(*problem, HUBER).weight)


@CAMERAS
@pytest.mark.parametrize("rho", [0.0, 1.0, 1e9])
def test_nothing_hostile_makes_a_nan(camera, rho):
    reference, target, _, affine = everything(camera, 2, 1)
    weight = reference.weight.clone()
    weight[1] = 0.0
    reference = replace(reference, rho=torch.full_like(reference.rho, rho), weight=weight)
    for xi in ((0.0,) * 6, (0.0, 0.0, -1.0, 0.0, 0.0, 0.0), (0.1, 0.2, -3.0, 0.0, 3.1, 0.0)):
        T = lie.se3_exp(torch.tensor([xi, xi], dtype=torch.float64))
        for part in linearize(reference, target, T, affine, HUBER):
            assert torch.isfinite(part).all()
            assert not part[1].any()


def test_a_pose_that_is_not_finite_spoils_its_own_pair_alone():
    problem = everything(FULL, 3, 1)
    good = linearize(*problem, HUBER)
    for bad in (math.nan, math.inf):
        T = problem[2].clone()
        T[1] = bad
        found = linearize(problem[0], problem[1], T, problem[3], HUBER)
        assert torch.equal(found.H[[0, 2]], good.H[[0, 2]])
        assert torch.equal(found.g[[0, 2]], good.g[[0, 2]])


def test_threads_and_the_rest_of_a_batch_change_no_bit():
    problem = everything(FULL, 5, 2)
    reference, target, T, affine = problem
    one = linearize(*problem, HUBER)
    torch.set_num_threads(2)
    try:
        two = linearize(*problem, HUBER)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    for k in range(5):
        at = torch.tensor([k])
        alone = linearize(reference.take(at), target.take(at), T[at], affine[at], HUBER)
        for a, b, c in zip(one, two, alone, strict=True):
            assert torch.equal(a, b)
            assert torch.equal(a[k], c[0])


@pytest.mark.parametrize("count", [0, 1, 15, 255, 256, 257, 4097])
def test_any_number_of_points_is_summed(count):
    reference, target, T, affine = everything(FULL, 2, 1)
    problem = reference.chunk(2000, 2000 + count), target, T, affine
    assert_equal(linearize(*problem, HUBER), eager.linearize(*problem, HUBER))


def test_an_empty_batch_gives_an_empty_answer():
    reference, target, T, affine = everything(FULL, 2, 1)
    found = linearize(reference.take(slice(0, 0)), target.take(slice(0, 0)), T[:0], affine[:0], HUBER)
    assert [part.shape[0] for part in found] == [0] * 5


def test_what_it_does_not_serve_is_refused_and_left_to_the_eager_kernel():
    reference, target, T, affine = plain(everything(FULL, 1, 1))
    with pytest.raises(InputError, match=r"^linearize: expected float32"):
        linearize(reference, target, T.requires_grad_(), affine, HUBER)
    assert select.linearize(reference, target, T, affine, HUBER).H.requires_grad
    T = T.detach()
    in_double = replace(target, padded=target.padded.double())
    with pytest.raises(InputError, match=r"^linearize: expected float32"):
        linearize(reference, in_double, T, affine, HUBER)
    for one, other in zip(
        select.linearize(reference, target, T, affine, HUBER),
        linearize(reference, target, T, affine, HUBER),
        strict=True,
    ):
        assert torch.equal(one, other)


def test_shapes_that_do_not_belong_together_are_refused():
    reference, target, T, affine = everything(FULL, 2, 1)
    for wrong in (
        (replace(reference, rho=reference.rho[:, 1:]), target, T, affine),
        (replace(reference, ray=reference.ray[..., :-1]), target, T, affine),
        (reference, replace(target, padded=target.padded[..., 1:]), T, affine),
        (reference, replace(target, camera=PLANE), T, affine),
        (reference, target, T[:1], affine),
        (reference, target, T, affine[:1]),
    ):
        with pytest.raises(ShapeError, match="expected shape"):
            linearize(*wrong, HUBER)


def test_without_numba_it_names_the_extra_and_selection_does_without(monkeypatch):
    problem = plain(everything(FULL, 1, 1))
    monkeypatch.setattr(select, "has_numba", lambda: False)
    select.linearize(*problem, HUBER)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "torchvo360.backends.numba.kernels.pairs", raising=False)
    with pytest.raises(InputError, match=r"^backend: expected numba .*torchvo360\[fast\]"):
        linearize(*problem, HUBER)


def test_numba_is_imported_by_its_first_call_alone_and_leaves_torchs_threads():
    code = """if True:
        import sys, torch, torchvo360, torchvo360.backends.numba, torchvo360.backends.select
        assert not any(name == "numba" or name.startswith("numba.") for name in sys.modules)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            import torchvo360.backends.numba.kernels.pairs
            assert torch.get_num_threads() == threads
    """
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


def test_what_is_compiled_now_and_what_was_compiled_before_give_the_same_bits(tmp_path):
    code = """if True:
        import hashlib, torch
        from tests.backends.test_numba import FULL, HUBER, everything, plain
        from torchvo360.backends.numba import linearize
        found = linearize(*plain(everything(FULL, 1, 1)), HUBER)
        print(hashlib.sha256(b"".join(part.contiguous().numpy().tobytes() for part in found)).hexdigest())
    """
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    root = Path(__file__).parents[2]
    runs = [
        subprocess.run(
            [sys.executable, "-c", code], check=True, timeout=200, env=environment, cwd=root, capture_output=True
        )
        for _ in range(2)
    ]
    assert any(tmp_path.rglob("*.nbc"))
    assert runs[0].stdout == runs[1].stdout
