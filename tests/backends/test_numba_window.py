"""The window's compiled pass means what torch means by its edges: in every option, at hard points, in any company."""

import threading
from dataclasses import replace

import pytest
import torch
from test_numba import EVERY, smooth
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends import backend
from torchvo360.cameras import Camera
from torchvo360.residuals.direct import Target, make_target
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import schur
from torchvo360.window import WindowConfig, WindowPoints, compiled, elimination, make_points
from torchvo360.window.energy import linearize_points, linearize_window
from torchvo360.window.state import Estimate
from torchvo360.window.stereo import Other
from torchvo360.window.system import WindowSystem

pytest.importorskip("numba")

K = 4
on_every_camera = pytest.mark.parametrize("camera", list(EVERY.values()), ids=list(EVERY))
CONFIG = WindowConfig(loss=LossConfig(scale=0.05))
LOSSES = [LossConfig(name="student_t", cutoff=0.3), LossConfig(name="none"), LossConfig(scale=0.05, cutoff=0.2)]
HARD = torch.tensor([[0, 1, 0], [0, -1, 0], [0, 0, -1], [1e-7, 0.3, -1], [-1e-7, 0.3, -1], [0, 0, 1], [1e-7, -1, 0]])


def rays_of(camera: Camera, seed: int) -> Tensor:
    """Unit rays all over the image, and on a full sphere at the poles and beside the seam."""
    g = torch.Generator().manual_seed(seed)
    uv = 1 + torch.rand(70, 2, generator=g) * torch.tensor([camera.width - 2, camera.height - 2])
    ray = camera.ray(uv)
    ray = torch.cat([ray, HARD]) if camera.wraps else ray
    return torch.nn.functional.normalize(ray, dim=-1).T.contiguous()


class Small:
    """Keyframes of smooth images with points in some of them."""

    def __init__(
        self,
        camera: Camera,
        *,
        masked: bool = False,
        hosts: tuple[int, ...] = tuple(range(K)),
        config: WindowConfig = CONFIG,
    ) -> None:
        self.camera, self.config = camera, config
        image = smooth(camera, 1, seed=3) + 0.1 * smooth(camera, K + 1, seed=6)
        doubt = (smooth(camera, K + 1, seed=7) > 0.35).float() if masked else None
        confidence = [None if doubt is None else doubt[k : k + 1] for k in range(K + 1)]
        made = [
            make_target(image[k][None, None], camera, confidence[k], 0.95 if masked else None) for k in range(K + 1)
        ]
        self.targets: list[Target] = made[:K]
        g = torch.Generator().manual_seed(5)
        parts: list[WindowPoints] = []
        for host in hosts:
            ray = rays_of(camera, host)
            rho = torch.rand(ray.shape[1], generator=g)
            rho[::5], rho[1] = 0.0, 1e6
            information = torch.rand(len(rho), generator=g)
            pixel = torch.arange(len(rho))
            parts.append(make_points(self.targets[host], pixel, ray, rho, config, host, information))
        self.points = parts[0]
        for part in parts[1:]:
            self.points = self.points.joined(part)
        self.points.rho_prior = self.points.rho + 0.1
        xi = torch.randn(2, K, 6, generator=g).double() * torch.tensor([0.06] * 3 + [0.03] * 3)
        self.T_first = lie.se3_exp(xi[0] + 0.1 * xi[1])
        affine = 0.05 * torch.randn(K, 2, generator=g).double()
        self.estimate = Estimate(lie.se3_exp(xi[0]), affine, self.points.rho)
        T = lie.se3_exp(torch.tensor([0.1, 0.01, -0.02, 0.01, -0.01, 0.02], dtype=torch.float64))
        self.other = Other(hosts[0], made[K], T, torch.tensor([0.1, -0.05], dtype=torch.float64))

    def system(self, name: str, **options: object) -> WindowSystem:
        with backend(name):
            return linearize_window(self.targets, self.points, self.estimate, self.config, **options)  # type: ignore[arg-type]

    def doubled(self) -> "Small":
        """The same in float64, which torch alone computes."""
        self.targets = [
            replace(t, padded=t.padded.double(), confidence=None if t.confidence is None else t.confidence.double())
            for t in self.targets
        ]
        parts = {name: part.double() for name, part in vars(self.points).items() if part.is_floating_point()}
        self.points = replace(self.points, **parts)
        self.estimate = self.estimate._replace(rho=self.points.rho)
        return self

    def without_points(self) -> "Small":
        self.points = self.points.take(torch.zeros(0, dtype=torch.long))
        self.estimate = self.estimate._replace(rho=self.points.rho)
        return self


def agree(found: WindowSystem, truth: WindowSystem, tolerance: float = 1e-4) -> None:
    """Hold one to the other; the tolerance leaves room for pixels that rounding puts into the next cell."""
    for name in ("H", "g", "cross", "curvature", "slope", "by_point", "thresholds"):
        a, b = getattr(found, name).double(), getattr(truth, name).double()
        assert a.shape == b.shape, name
        size = float(b.norm()) if b.numel() else 0.0
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * size + 1e-12, msg=lambda text, n=name: f"{n}: {text}")
    assert torch.equal(found.inliers, truth.inliers)
    assert found.edges == truth.edges
    assert found.energy == pytest.approx(truth.energy, rel=1e-4, abs=1e-12)


@on_every_camera
@pytest.mark.parametrize("first", [False, True], ids=["here", "first estimates"])
@pytest.mark.parametrize("known", [False, True], ids=["found", "given"])
@pytest.mark.parametrize("masked", [False, True], ids=["plain", "masked"])
def test_every_option_means_what_it_means_to_torch(camera, first, known, masked):
    small = Small(camera, masked=masked)
    T_first = small.T_first if first else None
    thresholds = torch.tensor([2e-3, 4e-3, 1e-3, 0.1]) if known else None
    found = small.system("numba", T_first=T_first, thresholds=thresholds)
    truth = small.doubled().system("eager", T_first=T_first, thresholds=thresholds)
    assert not found.cross.is_contiguous()
    assert float(truth.inliers.sum()) / truth.edges > 0.2
    agree(found, truth)


@on_every_camera
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
def test_every_loss_and_a_single_pixel(camera, loss):
    small = Small(camera, config=WindowConfig(loss=loss, pattern="single"))
    agree(small.system("numba"), small.system("eager"))


@on_every_camera
@pytest.mark.parametrize("hosts", [(0, 1, 3), (2,)], ids=["one hosts none", "one hosts all"])
def test_keyframes_without_points(camera, hosts):
    small = Small(camera, hosts=hosts)
    for thresholds in (None, torch.full((K,), 1e-2)):
        agree(*(small.system(name, thresholds=thresholds) for name in ("numba", "eager")))


def test_without_points_nothing_is_said():
    small = Small(EVERY["full"]).without_points()
    found = small.system("numba")
    assert found.edges == 0
    assert found.energy == 0
    assert found.cross.shape == (0, 8 * K)
    assert not found.H.any()
    agree(found, small.system("eager"))


@on_every_camera
def test_a_rigs_further_image_adds_the_same(camera):
    small = Small(camera)
    agree(small.system("numba", others=[small.other]), small.system("eager", others=[small.other]))


@on_every_camera
@pytest.mark.parametrize("name", ["numba", "eager"])
def test_the_points_equations_alone_are_those_of_the_whole(camera, name):
    small = Small(camera, masked=True)
    with backend(name):
        whole = linearize_window(small.targets, small.points, small.estimate, CONFIG, others=[small.other])
        alone = linearize_points(small.targets, small.points, small.estimate, CONFIG, others=[small.other])
    for part in ("curvature", "slope", "by_point", "inliers", "thresholds"):
        torch.testing.assert_close(getattr(alone, part), getattr(whole, part), rtol=1e-4, atol=1e-6)
    assert alone.edges == whole.edges


@pytest.mark.parametrize("count", [1, 31, 32, 33, 127, 129, 300])
def test_points_are_eliminated_as_by_torch(count):
    g = torch.Generator().manual_seed(count)
    cross = torch.randn(16, count, generator=g, dtype=torch.float64).mT
    H, g_, x = torch.eye(16).double(), torch.ones(16).double(), torch.arange(16).double()
    diagonal, slope = 0.5 + torch.rand(2, count, generator=g, dtype=torch.float64)
    diagonal[0] = torch.inf
    found, truth = elimination.reduce(H, g_, cross, diagonal, slope), schur.reduce(H, g_, cross, diagonal, slope)
    torch.testing.assert_close(found.A, truth.A)
    torch.testing.assert_close(found.b, truth.b)
    assert torch.equal(found.A, found.A.mT)
    step = elimination.back_substitute(x, cross, diagonal, slope)
    torch.testing.assert_close(step, schur.back_substitute(x, cross, diagonal, slope))


def test_threads_change_no_bit():
    small = Small(EVERY["full"])
    one = small.system("numba", T_first=small.T_first)
    beside: list[WindowSystem] = []
    torch.set_num_threads(2)
    try:
        threads = [
            threading.Thread(target=lambda: beside.append(small.system("numba", T_first=small.T_first)))
            for _ in range(2)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        torch.set_num_threads(1)
    for other in beside:
        for a, b in zip(one, other, strict=True):
            assert torch.equal(a, b) if isinstance(a, Tensor) else a == b
    assert len(beside) == 2


def test_what_it_does_not_serve_is_left_to_torch():
    small = Small(EVERY["full"])
    targets, points, estimate = small.targets, small.points, small.estimate
    assert compiled.serves(targets, points, estimate)
    in_double = [replace(target, padded=target.padded.double()) for target in targets]
    bad = estimate.T_cam_world.clone()
    bad[1, 0, 0] = torch.nan
    for others in (
        (in_double, points, estimate),
        (targets, points, estimate._replace(rho=estimate.rho.double())),
        (targets, points, estimate._replace(intrinsics=torch.ones(4).double())),
        (targets, points, estimate._replace(affine=estimate.affine.clone().requires_grad_())),
        (targets, points, estimate._replace(T_cam_world=bad)),
        ([replace(targets[0], camera=EVERY["pinhole"]), *targets[1:]], points, estimate),
    ):
        assert not compiled.serves(*others)
    with backend("eager"):
        assert not compiled.serves(targets, points, estimate)
