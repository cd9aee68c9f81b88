"""The contract of a camera, held by every one of them: round trips, derivatives, singular points, areas.

Each camera has a model of its own in `reference_pixel` and `reference_ray`, written from mathematics.md, section 2,
with its intrinsics as a tensor, so that every closed form is held to forward-mode derivatives of something else.
"""

import math
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacfwd, vmap
from torch.nn.functional import normalize

from torchvo360 import lie
from torchvo360.cameras import Camera, Equirectangular, Pinhole, check_image_size
from torchvo360.checks import InputError, ShapeError

FULL_SPHERES = {
    "sphere": Equirectangular(64, 32),
    "sphere, odd": Equirectangular(37, 19),
    "sphere, tiny": Equirectangular(7, 5),
    "sphere, stretched": Equirectangular(640, 322),
    "sphere, turned": Equirectangular(64, 32, cx=11.3),
}
PARTIAL_SPHERES = {
    "part of a sphere": Equirectangular(41, 30, 30.0, -28.0, 18.5, 16.2),
    "part of a sphere, mirrored": Equirectangular(40, 31, -30.0, 28.0, 18.5, 16.2),
    "part of a sphere, behind": Equirectangular(40, 30, 30.0, -28.0, 20 - 30 * math.pi, 15.0),
}
PINHOLES = {
    "pinhole": Pinhole(48, 36, 40.0, 42.0, 23.1, 17.4),
    "pinhole, odd": Pinhole(33, 25, 30.0, 30.0, 16.5, 12.5),
    "pinhole, v up": Pinhole(32, 24, 31.0, -30.0, 15.5, 12.0),
}
CAMERAS: dict[str, Camera] = {**FULL_SPHERES, **PARTIAL_SPHERES, **PINHOLES}

DTYPES = [torch.float32, torch.float64]
BATCHES = [(), (5,), (2, 3)]
RANGES = (0.3, 8.0)

on_every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
on_full_spheres = pytest.mark.parametrize("camera", FULL_SPHERES.values(), ids=FULL_SPHERES.keys())
on_partial_spheres = pytest.mark.parametrize("camera", PARTIAL_SPHERES.values(), ids=PARTIAL_SPHERES.keys())
on_pinholes = pytest.mark.parametrize("camera", PINHOLES.values(), ids=PINHOLES.keys())
in_every_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
on_every_batch = pytest.mark.parametrize("batch", BATCHES, ids=str)


def reference_pixel(camera: Camera, k: Float[Tensor, "4"], p: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    """The pixel of one point for intrinsics k; on a sphere up to whole turns of u."""
    x, y, z = p.unbind(-1)
    if isinstance(camera, Pinhole):
        a, b = x / z, y / z
    else:
        a, b = torch.atan2(x, z), -torch.atan2(y, torch.hypot(x, z))
    return torch.stack([k[0] * a + k[2], k[1] * b + k[3]], -1)


def reference_ray(camera: Camera, k: Float[Tensor, "4"], uv: Float[Tensor, "2"]) -> Float[Tensor, "3"]:
    """The ray of one pixel for intrinsics k."""
    a, b = (uv[0] - k[2]) / k[0], (uv[1] - k[3]) / k[1]
    if isinstance(camera, Pinhole):
        return torch.stack([a, b, torch.ones_like(a)])
    return torch.stack([torch.cos(b) * torch.sin(a), -torch.sin(b), torch.cos(b) * torch.cos(a)])


def intrinsics_of(camera: Camera) -> Float[Tensor, "4"]:
    return torch.tensor(camera.intrinsics, dtype=torch.float64)


def close(actual: Tensor, expected: Tensor, atol: float, rtol: float = 0.0) -> None:
    torch.testing.assert_close(actual, expected, atol=atol, rtol=rtol)


def close_pixels(camera: Camera, actual: Float[Tensor, "*batch 2"], expected: Float[Tensor, "*batch 2"], atol: float):
    """Hold pixels equal, on a sphere up to whole turns of u."""
    difference = actual - expected
    if isinstance(camera, Equirectangular):
        period = abs(camera.intrinsics[0]) * math.tau
        u = torch.remainder(difference[..., 0] + period / 2, period) - period / 2
        difference = torch.stack([u, difference[..., 1]], -1)
    close(difference, torch.zeros_like(difference), atol)


def random_pixels(camera: Camera, batch: tuple[int, ...], seed: int = 0) -> Float[Tensor, "*batch 2"]:
    """Pixels half a pixel or more inside the image."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([camera.width - 1, camera.height - 1], dtype=torch.float64)
    return 0.5 + size * torch.rand(*batch, 2, generator=generator, dtype=torch.float64)


def seen_points(camera: Camera, batch: tuple[int, ...], seed: int = 0) -> Float[Tensor, "*batch 3"]:
    """Points inside the image at random ranges, and no nearer to an edge than half a pixel."""
    generator = torch.Generator().manual_seed(seed + 1000)
    distance = RANGES[0] + (RANGES[1] - RANGES[0]) * torch.rand(*batch, 1, generator=generator, dtype=torch.float64)
    uv = random_pixels(camera, batch, seed).reshape(-1, 2)
    rays = vmap(lambda pixel: reference_ray(camera, intrinsics_of(camera), pixel))(uv)
    return rays.reshape(*batch, 3) * distance


def regular_points(camera: Camera) -> Float[Tensor, "N 3"]:
    """Points where every derivative exists: random ones and those beside the singular ones."""
    points = [seen_points(camera, (40,))]
    if isinstance(camera, Pinhole):
        points.append(torch.tensor([[0.0, 0.0, 1e-3], [3.0, -2.0, 0.05], [0.0, 0.0, 2.0]], dtype=torch.float64))
    else:
        generator = torch.Generator().manual_seed(7)
        points.append(torch.randn(40, 3, generator=generator, dtype=torch.float64))
        # The seam from both sides, straight up and down but for a little, forward and backward.
        beside = [(1e-9, 0.2, -1.0), (-1e-9, 0.2, -1.0), (0.0, 0.3, -2.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]
        near_poles = [(1e-3, 1.0, 0.0), (0.0, -1.0, -1e-3), (1e-3, -2.0, 1e-3), (-1e-2, 1.0, 1e-4)]
        points.append(torch.tensor(beside + near_poles, dtype=torch.float64))
    return torch.cat(points)


def singular_points(camera: Camera, dtype: torch.dtype) -> Float[Tensor, "N 3"]:
    """Points that no pixel shows: the vertical axis of a sphere, the plane of a pinhole and all behind it."""
    if isinstance(camera, Pinhole):
        points = [
            (0.0, 0.0, 0.0),
            (1.0, -2.0, 0.0),
            (0.0, 0.0, -1.0),
            (1.0, 2.0, -3.0),
            (1.0, 1.0, 1e-30),
            (0.3, 0.0, -0.0),
        ]
    else:
        points = [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -2.0, 0.0), (-0.0, 1e-3, -0.0), (1e-30, 1.0, -1e-30)]
    return torch.tensor(points, dtype=dtype)


def beyond_the_first_row(camera: Camera, rays: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Rays farther from a pole than the first row's centre: nearer, a covector is bounded instead of exact."""
    if isinstance(camera, Pinhole):
        return rays
    kept = rays[torch.hypot(rays[:, 0], rays[:, 2]) > math.sin(0.5 / abs(camera.intrinsics[1]))]
    assert len(kept) > len(rays) / 2
    return kept


def smooth_image(camera: Camera, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """A smooth image, periodic in u with the sphere's period."""
    u = uv[..., 0] * (math.tau / (abs(camera.intrinsics[0]) * math.tau))
    v = uv[..., 1] / camera.height
    return torch.sin(u + 0.4) * torch.cos(2.2 * v) + 0.3 * torch.cos(2 * u - 3 * v) + 0.2 * v


def gradient_by_pixel(camera: Camera, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 2"]:
    return vmap(jacfwd(lambda pixel: smooth_image(camera, pixel)))(uv)


class TestRoundTrips:
    @on_every_camera
    @in_every_dtype
    @on_every_batch
    def test_a_pixel_projects_back_from_its_ray(self, camera: Camera, dtype: torch.dtype, batch: tuple[int, ...]):
        uv = random_pixels(camera, batch).to(dtype)
        back, valid = camera.project(camera.ray(uv))
        assert back.shape == uv.shape
        assert back.dtype == dtype
        assert valid.shape == batch
        assert bool(valid.all())
        close_pixels(camera, back, uv, 1e-11 if dtype == torch.float64 else 2e-6 * camera.width)

    @on_every_camera
    @in_every_dtype
    def test_every_pixel_centre_is_seen_and_comes_back(self, camera: Camera, dtype: torch.dtype):
        grid = camera.pixel_grid(dtype=dtype)
        rays = camera.ray_grid(dtype=dtype)
        assert grid.shape == (camera.height, camera.width, 2)
        assert rays.shape == (camera.height, camera.width, 3)
        assert grid[0, 0].tolist() == [0.5, 0.5]
        assert grid[-1, -1].tolist() == [camera.width - 0.5, camera.height - 0.5]
        uv, valid = camera.project(rays)
        assert bool(valid.all())
        # One rounding of a ray near a pole moves its longitude by many.
        close(uv, grid, 1e-9 if dtype == torch.float64 else 1e-2)
        close(rays.double(), camera.ray_grid(dtype=torch.float64), torch.finfo(dtype).eps)

    @on_every_camera
    @in_every_dtype
    @on_every_batch
    def test_rays_have_range_one_and_points_are_ray_times_range(
        self, camera: Camera, dtype: torch.dtype, batch: tuple[int, ...]
    ):
        eps = torch.finfo(dtype).eps
        close(camera.scale(camera.ray(random_pixels(camera, batch).to(dtype))), torch.ones(batch, dtype=dtype), 4 * eps)
        p_cam = seen_points(camera, batch).to(dtype)
        uv, _ = camera.project(p_cam)
        close(camera.ray(uv) * camera.scale(p_cam)[..., None], p_cam, 100 * eps * RANGES[1])

    @on_every_camera
    @in_every_dtype
    @pytest.mark.parametrize("factor", [1e-6, 0.37, 1e6])
    def test_any_positive_multiple_gives_the_same_pixel(self, camera: Camera, dtype: torch.dtype, factor: float):
        p_cam = seen_points(camera, (50,)).to(dtype)
        uv, valid = camera.project(p_cam)
        uv_scaled, valid_scaled = camera.project(factor * p_cam)
        close_pixels(camera, uv_scaled, uv, (1e-11 if dtype == torch.float64 else 2e-6) * camera.width)
        assert bool((valid == valid_scaled).all())
        close(camera.scale(factor * p_cam), factor * camera.scale(p_cam), 0, rtol=8 * torch.finfo(dtype).eps)

    @on_every_camera
    def test_pixels_and_rays_follow_the_model(self, camera: Camera):
        k, points, pixels = intrinsics_of(camera), regular_points(camera), random_pixels(camera, (50,))
        expected = vmap(lambda p: reference_pixel(camera, k, p))(points)
        close_pixels(camera, camera.pixel(points), expected, 1e-10)
        close_pixels(camera, camera.project(points)[0], expected, 1e-10)
        close(camera.ray(pixels), vmap(lambda uv: reference_ray(camera, k, uv))(pixels), 1e-14)

    @on_every_camera
    @in_every_dtype
    @on_every_batch
    def test_apart_and_stacked_components_agree(self, camera: Camera, dtype: torch.dtype, batch: tuple[int, ...]):
        p_cam = seen_points(camera, batch).to(dtype)
        ray, g_uv = p_cam / camera.scale(p_cam)[..., None], random_pixels(camera, batch, 3).to(dtype)
        eps = torch.finfo(dtype).eps
        close(torch.stack(camera.pixel_of(*p_cam.unbind(-1)), -1), camera.pixel(p_cam), 0)
        normalized = torch.stack(camera.normalized_of(*p_cam.unbind(-1)), -1).double()
        k = intrinsics_of(camera)
        close_pixels(camera, normalized * k[:2] + k[2:], camera.pixel(p_cam).double(), 8 * eps * camera.width)
        close(camera.scale_of(*p_cam.unbind(-1)), camera.scale(p_cam), 4 * eps * RANGES[1])
        x, y, z = ray.unbind(-1)
        close(torch.stack(camera.covector_of((x, y, z), *g_uv.unbind(-1)), -1), camera.covector(ray, g_uv), 0)

    @on_every_camera
    def test_components_may_lie_apart_in_memory(self, camera: Camera):
        p_cam = seen_points(camera, (4, 6))
        apart = p_cam.movedim(-1, 0).contiguous().movedim(0, -1)
        assert not apart.is_contiguous()
        for function in (camera.scale, camera.pixel, camera.pixel_jacobian_point, camera.pixel_jacobian_intrinsics):
            close(function(apart), function(p_cam), 1e-14, rtol=1e-14)

    @on_every_camera
    def test_wrong_shapes_are_refused_by_name(self, camera: Camera):
        with pytest.raises(ShapeError, match=r"^uv: expected shape \[\.\.\. 2\], got \[5, 3\]"):
            camera.ray(torch.zeros(5, 3))
        with pytest.raises(ShapeError, match=r"^p_cam: expected shape \[\.\.\. 3\], got \[5, 2\]"):
            camera.project(torch.zeros(5, 2))
        with pytest.raises(ShapeError, match=r"^ref: expected shape"):
            check_image_size("ref", torch.zeros(3, camera.height + 1, camera.width), camera)
        check_image_size("ref", torch.zeros(3, camera.height, camera.width), camera)


class TestDerivatives:
    """Every closed form against forward-mode derivatives of the reference model."""

    @on_every_camera
    def test_pixel_by_point(self, camera: Camera):
        k, points = intrinsics_of(camera), regular_points(camera)
        expected = vmap(jacfwd(lambda p: reference_pixel(camera, k, p)))(points)
        close(camera.pixel_jacobian_point(points), expected, 1e-9, rtol=1e-9)
        close(vmap(jacfwd(camera.pixel))(points), expected, 1e-9, rtol=1e-9)
        close(vmap(jacfwd(lambda p: camera.project(p)[0]))(points), expected, 1e-9, rtol=1e-9)

    @on_every_camera
    def test_pixel_by_intrinsics(self, camera: Camera):
        k, points = intrinsics_of(camera), regular_points(camera)
        expected = vmap(jacfwd(lambda k, p: reference_pixel(camera, k, p)), in_dims=(None, 0))(k, points)
        close(camera.pixel_jacobian_intrinsics(points), expected, 1e-12, rtol=1e-12)

    @on_every_camera
    def test_ray_by_intrinsics(self, camera: Camera):
        k, pixels = intrinsics_of(camera), random_pixels(camera, (50,))
        expected = vmap(jacfwd(lambda k, uv: reference_ray(camera, k, uv)), in_dims=(None, 0))(k, pixels)
        close(camera.ray_jacobian_intrinsics(pixels), expected, 1e-14)
        unit = vmap(jacfwd(lambda k, uv: normalize(reference_ray(camera, k, uv), dim=0)), in_dims=(None, 0))(k, pixels)
        close(camera.unit_ray_jacobian_intrinsics(pixels), unit, 1e-14)

    @on_every_camera
    def test_ray_by_intrinsics_that_stand_in(self, camera: Camera):
        pixels = random_pixels(camera, (50,))
        k = intrinsics_of(camera) + torch.tensor([[0.3, -0.2, 1.4, -0.7], [-0.1, 0.4, 0.0, 0.5]], dtype=torch.float64)
        by_k = vmap(jacfwd(lambda k, uv: reference_ray(camera, k, uv)), in_dims=(None, 0))
        expected = torch.stack([by_k(each, pixels) for each in k])
        fx, fy, cx, cy = k[:, :, None].unbind(1)
        close(camera.ray_jacobian_intrinsics(pixels, (fx, fy, cx, cy)), expected, 1e-14)
        rays = camera.ray(pixels, (fx, fy, cx, cy))
        length = torch.linalg.vector_norm(rays, dim=-1)[..., None, None]
        across = torch.eye(3, dtype=torch.float64) - rays[..., None] * rays[..., None, :] / length**2
        close(camera.unit_ray_jacobian_intrinsics(pixels, (fx, fy, cx, cy)), across @ expected / length, 1e-14)

    @on_every_camera
    def test_scale_by_point(self, camera: Camera):
        points = regular_points(camera)
        expected = torch.zeros_like(points)
        if isinstance(camera, Pinhole):
            expected[:, 2] = 1.0
        else:
            expected = points / points.square().sum(-1, keepdim=True).sqrt()
        close(vmap(jacfwd(camera.scale))(points), expected, 1e-14)
        close(vmap(jacfwd(lambda p: camera.scale_of(*p.unbind(-1))))(points), expected, 1e-14)

    @on_every_camera
    @on_every_batch
    def test_jacobians_take_any_batch(self, camera: Camera, batch: tuple[int, ...]):
        p_cam, uv = seen_points(camera, batch), random_pixels(camera, batch)
        assert camera.pixel_jacobian_point(p_cam).shape == (*batch, 2, 3)
        assert camera.pixel_jacobian_intrinsics(p_cam).shape == (*batch, 2, 4)
        assert camera.ray_jacobian_intrinsics(uv).shape == (*batch, 3, 4)
        assert camera.covector(camera.ray(uv), uv).shape == (*batch, 3)
        assert camera.solid_angle(uv).shape == batch


class TestCovector:
    @on_every_camera
    def test_it_is_the_gradient_of_the_image_by_the_ray(self, camera: Camera):
        k, points = intrinsics_of(camera), regular_points(camera)
        rays = beyond_the_first_row(camera, points / camera.scale(points)[..., None])
        G = camera.covector(rays, gradient_by_pixel(camera, camera.project(rays)[0]))
        expected = vmap(jacfwd(lambda p: smooth_image(camera, reference_pixel(camera, k, p))))(rays)
        close(G, expected, 1e-10, rtol=1e-9)

    @on_every_camera
    @in_every_dtype
    def test_it_is_orthogonal_to_the_ray(self, camera: Camera, dtype: torch.dtype):
        points = regular_points(camera)
        rays = (points / camera.scale(points)[..., None]).to(dtype)
        g_uv = random_pixels(camera, (len(rays),), 5).to(dtype)
        G = camera.covector(rays, g_uv)
        norms = torch.linalg.vector_norm(G, dim=-1) * torch.linalg.vector_norm(rays, dim=-1)
        assert bool(((G * rays).sum(-1).abs() <= 8 * torch.finfo(dtype).eps * norms).all())

    @on_every_camera
    @in_every_dtype
    def test_the_gradient_comes_back_from_it(self, camera: Camera, dtype: torch.dtype):
        points = regular_points(camera)
        rays = beyond_the_first_row(camera, points / camera.scale(points)[..., None]).to(dtype)
        g_uv = random_pixels(camera, (len(rays),), 5).to(dtype)
        fx, fy, cx, cy = (part + 0.3 for part in camera.intrinsics)
        for k in (None, (fx, fy, cx, cy)):
            x, y, z = rays.unbind(-1)
            G = camera.covector_of((x, y, z), g_uv[:, 0], g_uv[:, 1], k)
            back = torch.stack(camera.gradient_of((x, y, z), G, k), -1)
            close(back, g_uv, 1e-13 * camera.width if dtype == torch.float64 else 1e-5 * camera.width)

    @on_full_spheres
    @in_every_dtype
    def test_within_the_first_row_the_gradient_that_comes_back_falls_to_zero(
        self, camera: Equirectangular, dtype: torch.dtype
    ):
        first_row = 0.5 / abs(camera.intrinsics[1])
        angle = first_row * torch.tensor([1.0, 0.5, 1e-2, 1e-6, 0.0], dtype=torch.float64)
        x, y, z = (part.to(dtype) for part in (0.6 * angle.sin(), -angle.cos(), 0.8 * angle.sin()))
        one = torch.ones(5, dtype=dtype)
        g_u, g_v = camera.gradient_of((x, y, z), camera.covector_of((x, y, z), one, one))
        held = (angle.sin() / math.sin(first_row)).to(dtype)
        close(g_u, held**2, 1e-5)
        close(g_v, held, 1e-5)

    @on_full_spheres
    @in_every_dtype
    def test_within_the_first_row_it_is_bounded_and_goes_to_zero(self, camera: Equirectangular, dtype: torch.dtype):
        fx, fy, _, _ = camera.intrinsics
        first_row = 0.5 / abs(fy)
        angle = first_row * torch.tensor([1.0, 0.5, 1e-2, 1e-6, 0.0], dtype=torch.float64)
        rays = torch.stack([0.6 * angle.sin(), -angle.cos(), 0.8 * angle.sin()], -1).to(dtype)
        norms = torch.linalg.vector_norm(camera.covector(rays, torch.ones(5, 2, dtype=dtype)), dim=-1)
        at_first_row = math.hypot(fx / math.sin(first_row), fy)
        close(norms, (at_first_row * angle.sin() / math.sin(first_row)).to(dtype), 0, rtol=2e-2)

    @on_full_spheres
    def test_on_the_sphere_it_is_made_of_east_and_north(self, camera: Equirectangular):
        """Equations.md, section 3: G = (g_u f_x / cos lat) e_lon + (g_v f_y) e_lat."""
        fx, fy, cx, cy = camera.intrinsics
        uv, g = random_pixels(camera, (50,)), random_pixels(camera, (50,), 6)
        lon, lat = (uv[:, 0] - cx) / fx, (uv[:, 1] - cy) / fy
        e_lon = torch.stack([lon.cos(), torch.zeros_like(lon), -lon.sin()], -1)
        e_lat = torch.stack([-lat.sin() * lon.sin(), -lat.cos(), -lat.sin() * lon.cos()], -1)
        expected = (g[:, 0] * fx / lat.cos())[:, None] * e_lon + (g[:, 1] * fy)[:, None] * e_lat
        close(camera.covector(camera.ray(uv), g), expected, 1e-10, rtol=1e-11)


class TestKernel:
    """The rows of every alignment (mathematics.md, sections 3 and 4) from nothing but the contract."""

    @pytest.fixture
    def motion(self) -> Float[Tensor, "4 4"]:
        return lie.se3_exp(torch.tensor([0.11, -0.07, 0.16, 0.05, -0.03, 0.04], dtype=torch.float64))

    def references(self, camera: Camera) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N"]]:
        """Reference pixels that stay in view and off the poles, and inverse ranges, the first third of them 0."""
        middle = torch.tensor([camera.width, camera.height], dtype=torch.float64) / 2
        rho = torch.linspace(-1.0, 2.0, 60, dtype=torch.float64).clamp_min(0.0)
        inset = torch.tensor([1.0, 0.6] if camera.wraps else [0.4, 0.4], dtype=torch.float64)
        return middle + inset * (random_pixels(camera, (60,)) - middle), rho

    @on_every_camera
    def test_rows_by_pose_inverse_range_and_intrinsics(self, camera: Camera, motion: Float[Tensor, "4 4"]):
        k = intrinsics_of(camera)
        uv1, rho1 = self.references(camera)
        R, t = motion[:3, :3], motion[:3, 3]

        def intensity(xi: Tensor, rho: Tensor, k: Tensor, uv: Tensor) -> Tensor:
            T = lie.se3_exp(xi) @ motion
            Y = T[:3, :3] @ reference_ray(camera, k, uv) + rho * T[:3, 3]
            return smooth_image(camera, reference_pixel(camera, k, Y))

        zero = torch.zeros(6, dtype=torch.float64)
        by_xi, by_rho, by_k = vmap(jacfwd(intensity, argnums=(0, 1, 2)), in_dims=(None, 0, None, 0))(zero, rho1, k, uv1)

        Y = camera.ray(uv1) @ R.mT + rho1[:, None] * t
        s = camera.scale(Y)[:, None]
        r2, rho2 = Y / s, rho1[:, None] / s
        uv2, valid = camera.project(Y)
        assert bool(valid.all())
        g = gradient_by_pixel(camera, uv2)
        G = camera.covector(r2, g)
        close(torch.cat([rho2 * G, torch.linalg.cross(r2, G)], -1), by_xi, 1e-10, rtol=1e-10)
        close(((G @ t)[:, None] / s)[:, 0], by_rho, 1e-10, rtol=1e-10)
        direct = torch.einsum("ni,nik->nk", g, camera.pixel_jacobian_intrinsics(Y))
        through_ray = torch.einsum("ni,ij,njk->nk", G, R, camera.ray_jacobian_intrinsics(uv1)) / s
        close(direct + through_ray, by_k, 1e-10, rtol=1e-10)

    @on_every_camera
    def test_pixel_rows_chain_through_the_point(self, camera: Camera, motion: Float[Tensor, "4 4"]):
        """J_uv_xi = J_uv_Y [rho1 I, -hat(Y)]: the textbook Jacobian, points at infinity included."""
        k = intrinsics_of(camera)
        uv1, rho1 = self.references(camera)

        def pixel(xi: Tensor, rho: Tensor, uv: Tensor) -> Tensor:
            T = lie.se3_exp(xi) @ motion
            return reference_pixel(camera, k, T[:3, :3] @ reference_ray(camera, k, uv) + rho * T[:3, 3])

        zero = torch.zeros(6, dtype=torch.float64)
        by_xi, by_rho = vmap(jacfwd(pixel, argnums=(0, 1)), in_dims=(None, 0, 0))(zero, rho1, uv1)
        Y = camera.ray(uv1) @ motion[:3, :3].mT + rho1[:, None] * motion[:3, 3]
        J_uv_Y = camera.pixel_jacobian_point(Y)
        eye = torch.eye(3, dtype=torch.float64)
        J_Y_xi = torch.cat([rho1[:, None, None] * eye, -lie.so3_hat(Y)], -1)
        close(J_uv_Y @ J_Y_xi, by_xi, 1e-9, rtol=1e-10)
        close(J_uv_Y @ motion[:3, 3], by_rho, 1e-9, rtol=1e-10)

    @on_full_spheres
    def test_the_explicit_spherical_jacobian(self, camera: Equirectangular, motion: Float[Tensor, "4 4"]):
        """Equations.md, section 4: 360VO's Jacobian with its slips corrected."""
        k = intrinsics_of(camera)
        fx, fy, _, _ = camera.intrinsics
        uv1, rho1 = self.references(camera)
        R, t = motion[:3, :3], motion[:3, 3]

        def pixel(xi: Tensor, rho: Tensor, uv: Tensor) -> Tensor:
            T = lie.se3_exp(xi) @ motion
            return reference_pixel(camera, k, T[:3, :3] @ reference_ray(camera, k, uv) + rho * T[:3, 3])

        zero = torch.zeros(6, dtype=torch.float64)
        by_xi, by_rho = vmap(jacfwd(pixel, argnums=(0, 1)), in_dims=(None, 0, 0))(zero, rho1, uv1)

        Y = camera.ray(uv1) @ R.mT + rho1[:, None] * t
        s = camera.scale(Y)
        (x, y, z), rho2 = (Y / s[:, None]).unbind(-1), rho1 / s
        q = x * x + z * z
        c, o = q.sqrt(), torch.zeros_like(x)
        du = [fx * rho2 * z / q, o, -fx * rho2 * x / q, -fx * x * y / q, o + fx, -fx * y * z / q]
        dv = [fy * rho2 * x * y / c, -fy * rho2 * c, fy * rho2 * y * z / c, fy * z / c, o, -fy * x / c]
        close(torch.stack([torch.stack(du, -1), torch.stack(dv, -1)], -2), by_xi, 1e-9, rtol=1e-10)
        r2_t = x * t[0] + y * t[1] + z * t[2]
        du_drho = fx * (z * t[0] - x * t[2]) / (q * s)
        dv_drho = -fy * (t[1] - y * r2_t) / (c * s)
        close(torch.stack([du_drho, dv_drho], -1), by_rho, 1e-9, rtol=1e-10)

    @on_every_camera
    def test_the_inverse_range_follows_from_a_match(self, camera: Camera, motion: Float[Tensor, "4 4"]):
        """Equations.md, section 5: rho1 = -(n . (r2 x R r1)) / (n . n), n = r2 x t, for rays of either measure."""
        uv1, rho1 = self.references(camera)
        R_r1 = camera.ray(uv1) @ motion[:3, :3].mT
        t = motion[:3, 3]
        r2 = camera.ray(camera.project(R_r1 + rho1[:, None] * t)[0])
        n = torch.linalg.cross(r2, t.expand_as(r2))
        rho = -(n * torch.linalg.cross(r2, R_r1)).sum(-1) / (n * n).sum(-1)
        close(rho, rho1, 1e-10)


class TestSingularPoints:
    @on_every_camera
    @in_every_dtype
    def test_they_are_invalid_with_finite_pixels_and_no_derivative(self, camera: Camera, dtype: torch.dtype):
        points = singular_points(camera, dtype)
        uv, valid = camera.project(points)
        assert not bool(valid.any())
        for value in (uv, camera.pixel(points), camera.pixel_jacobian_intrinsics(points)):
            assert bool(torch.isfinite(value).all())
        close(camera.pixel_jacobian_point(points), torch.zeros(len(points), 2, 3, dtype=dtype), 0)

    @on_every_camera
    @in_every_dtype
    def test_gradients_are_finite_there_in_reverse_and_forward_mode(self, camera: Camera, dtype: torch.dtype):
        points = singular_points(camera, dtype).requires_grad_()
        g_uv = torch.ones(len(points), 2, dtype=dtype)
        values = [
            ("project", camera.project(points)[0]),
            ("pixel", camera.pixel(points)),
            ("scale", camera.scale(points)),
            ("scale_of", camera.scale_of(*points.unbind(-1))),
            ("covector", camera.covector(points, g_uv)),
            ("pixel_jacobian_point", camera.pixel_jacobian_point(points)),
            ("pixel_jacobian_intrinsics", camera.pixel_jacobian_intrinsics(points)),
        ]
        for name, value in values:
            assert bool(torch.isfinite(value).all()), name
            if value.requires_grad:
                (gradient,) = torch.autograd.grad(value.sum(), points, allow_unused=True)
                assert gradient is None or bool(torch.isfinite(gradient).all()), name
        points = points.detach()
        for function in (camera.pixel, lambda p: camera.project(p)[0]):
            assert bool(torch.isfinite(vmap(jacfwd(function))(points)).all())

    @on_full_spheres
    @in_every_dtype
    def test_the_vertical_axis_has_its_row_and_gives_no_gradient(self, camera: Equirectangular, dtype: torch.dtype):
        points = torch.tensor([[0.0, -2.0, 0.0], [0.0, 0.5, 0.0]], dtype=dtype, requires_grad=True)
        uv, _ = camera.project(points)
        (gradient,) = torch.autograd.grad(uv.sum(), points)
        close(uv[:, 1], torch.tensor([0.0, camera.height], dtype=dtype), 4 * torch.finfo(dtype).eps * camera.height)
        close(gradient, torch.zeros_like(gradient), 0)

    @on_every_camera
    @in_every_dtype
    def test_a_masked_singular_row_leaves_its_neighbours_gradient_alone(self, camera: Camera, dtype: torch.dtype):
        good = seen_points(camera, (6,)).to(dtype).requires_grad_()
        uv, valid = camera.project(torch.cat([good, singular_points(camera, dtype)]))
        loss = torch.where(valid[:, None], uv, torch.zeros_like(uv)).sum()
        (gradient,) = torch.autograd.grad(loss, good)
        (alone,) = torch.autograd.grad(camera.project(good)[0].sum(), good)
        close(gradient, alone, 0)

    @on_pinholes
    def test_points_behind_a_pinhole_never_pass_for_their_mirror_images(self, camera: Pinhole):
        p_cam = seen_points(camera, (50,))
        assert bool(camera.project(p_cam)[1].all())
        assert not bool(camera.project(-p_cam)[1].any())


class TestView:
    @on_full_spheres
    def test_a_full_sphere_wraps_and_sees_everything(self, camera: Equirectangular):
        generator = torch.Generator().manual_seed(1)
        p_cam = torch.randn(500, 3, generator=generator, dtype=torch.float64)
        uv, valid = camera.project(p_cam)
        assert camera.wraps
        assert camera.sees(p_cam, uv) is None
        assert bool(valid.all())

    @pytest.mark.parametrize(
        "camera", [*PARTIAL_SPHERES.values(), *PINHOLES.values()], ids=[*PARTIAL_SPHERES.keys(), *PINHOLES.keys()]
    )
    def test_a_bounded_image_sees_what_lies_inside_its_margin(self, camera: Camera):
        assert not camera.wraps
        generator = torch.Generator().manual_seed(1)
        inside = camera.ray(random_pixels(camera, (200,)))
        assert bool(camera.project(inside)[1].all())
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        # A frame of pixels around the image, up to 3 px outside it.
        frame = -3 + (size + 6) * torch.rand(2000, 2, generator=generator, dtype=torch.float64)
        is_inside = ((frame > 0) & (frame < size)).all(-1)
        rays = camera.ray(frame)
        uv, valid = camera.project(rays)
        assert 0 < int(is_inside.sum()) < len(frame)
        assert bool((valid == is_inside).all())
        deep = ((frame > 2) & (frame < size - 2)).all(-1)
        seen = camera.sees(rays, uv, margin=2.0)
        assert seen is not None
        assert bool((seen == deep).all())

    @on_partial_spheres
    def test_the_bare_pixel_of_a_partial_sphere_is_the_projected_one(self, camera: Equirectangular):
        """The hot path has no seam handling, yet a view that straddles the back of the sphere is seen whole."""
        rays = camera.ray(random_pixels(camera, (200,)))
        close(camera.pixel(rays), camera.project(rays)[0], 1e-11)

    @on_full_spheres
    @in_every_dtype
    def test_pixels_stay_inside_the_sphere_at_seam_and_poles(self, camera: Equirectangular, dtype: torch.dtype):
        tiny, back = torch.tensor([1e-30, 1e-9, 6e-8, 1e-7, 1e-6, 1e-3, 0.1], dtype=torch.float64), -1.0
        around_seam = [torch.stack([x, 0 * x, 0 * x + back], -1) for x in (tiny, -tiny, 0 * tiny, -0.0 * tiny)]
        near_poles = [torch.stack([x, 0 * x + y, 0 * x], -1) for x in (tiny, -tiny, 0 * tiny) for y in (1.0, -1.0)]
        # Pixels a hair either side of column 0, where rounding could give the width itself.
        u = torch.cat([tiny, -tiny, camera.width - tiny, camera.width + tiny])
        near_zero = camera.ray(torch.stack([u, torch.full_like(u, camera.height / 3)], -1))
        turns = torch.linspace(-math.pi, math.pi, 2001, dtype=torch.float64)
        around = torch.stack([turns.sin(), 0.3 * turns, turns.cos()], -1)
        uv, _ = camera.project(torch.cat([*around_seam, *near_poles, near_zero, around]).to(dtype))
        assert bool(((uv[:, 0] >= 0) & (uv[:, 0] < camera.width)).all())
        assert bool(((uv[:, 1] >= 0) & (uv[:, 1] <= camera.height)).all())

    @pytest.mark.parametrize("height", [7, 19, 128, 161, 256, 322, 512, 1000])
    @in_every_dtype
    def test_no_height_puts_a_pole_outside_the_image(self, height: int, dtype: torch.dtype):
        camera = Equirectangular(2 * height, height)
        uv, _ = camera.project(torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1e-7, -1.0, 0.0]], dtype=dtype))
        assert bool(((uv[:, 1] >= 0) & (uv[:, 1] <= height)).all())

    def test_the_middle_of_the_panorama_looks_forward_with_right_to_the_right_and_down_downwards(self):
        camera = Equirectangular(64, 32)
        uv, _ = camera.project(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [-1.0, 0.0, 0.0]]))
        close(uv, torch.tensor([[32.0, 16.0], [48.0, 16.0], [32.0, 24.0], [16.0, 16.0]]), 1e-5)


class TestAreasAndSizes:
    @on_full_spheres
    @in_every_dtype
    def test_the_pixels_of_a_sphere_cover_it(self, camera: Equirectangular, dtype: torch.dtype):
        total = camera.solid_angle(camera.pixel_grid(dtype=dtype)).double().sum().item()
        assert total == pytest.approx(4 * math.pi, rel=1e-12 if dtype == torch.float64 else 1e-6)

    @on_partial_spheres
    def test_the_pixels_of_a_partial_sphere_cover_their_patch(self, camera: Equirectangular):
        fx, fy, _, cy = camera.intrinsics
        top, bottom = (0 - cy) / fy, (camera.height - cy) / fy
        patch = camera.width / abs(fx) * abs(math.sin(top) - math.sin(bottom))
        total = camera.solid_angle(camera.pixel_grid(dtype=torch.float64)).sum().item()
        assert total == pytest.approx(patch, rel=1e-12)

    @on_pinholes
    def test_the_pixels_of_a_pinhole_have_the_area_of_their_corners(self, camera: Pinhole):
        """Each pixel is two spherical triangles, measured by Van Oosterom and Strackee's formula."""
        grid = camera.pixel_grid(dtype=torch.float64)
        offsets = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], dtype=torch.float64)
        a, b, c, d = (torch.nn.functional.normalize(camera.ray(grid + offset), dim=-1) for offset in offsets)

        def triangle(p: Tensor, q: Tensor, r: Tensor) -> Tensor:
            volume = (p * torch.linalg.cross(q, r)).sum(-1).abs()
            return 2 * torch.atan2(volume, 1 + (p * q).sum(-1) + (q * r).sum(-1) + (r * p).sum(-1))

        expected = triangle(a, b, c) + triangle(a, c, d)
        actual = camera.solid_angle(grid)
        close(actual, expected, 0, rtol=5e-4)
        assert actual.sum().item() == pytest.approx(expected.sum().item(), rel=2e-4)

    @on_every_camera
    @pytest.mark.parametrize("factors", [(0.5, 0.5), (0.25, 0.5), (2.0, 2.0), (1.0, 1.0), (3.0, 0.7)])
    def test_resizing_keeps_the_rays(self, camera: Camera, factors: tuple[float, float]):
        width, height = max(1, round(factors[0] * camera.width)), max(1, round(factors[1] * camera.height))
        resized = camera.resized(width, height)
        assert type(resized) is type(camera)
        assert (resized.width, resized.height) == (width, height)
        assert resized.wraps == camera.wraps
        uv = random_pixels(camera, (50,))
        ratio = torch.tensor([width / camera.width, height / camera.height], dtype=torch.float64)
        close(resized.ray(uv * ratio), camera.ray(uv), 1e-13)
        close(resized.resized(camera.width, camera.height).ray(uv), camera.ray(uv), 1e-13)

    @on_every_camera
    def test_the_pixel_angle_is_that_between_neighbours_in_the_middle(self, camera: Camera):
        _, _, cx, cy = camera.intrinsics
        ends = torch.tensor([[cx - 0.5, cy], [cx + 0.5, cy]], dtype=torch.float64)
        a, b = torch.nn.functional.normalize(camera.ray(ends), dim=-1)
        angle = torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b)), a @ b).item()
        assert camera.pixel_angle == pytest.approx(angle, rel=1e-3)


class TestConstruction:
    @pytest.mark.parametrize("size", [0, -4, 2.5, "64", None])
    @pytest.mark.parametrize("name", ["width", "height"])
    @on_every_camera
    def test_sizes_are_positive_integers(self, camera: Camera, name: str, size: object):
        with pytest.raises(InputError, match=rf"^{name}: expected a positive integer, got "):
            replace(camera, **{name: size})

    @pytest.mark.parametrize("value", [math.nan, math.inf, "1"])
    @pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy"])
    @on_every_camera
    def test_intrinsics_are_finite_numbers(self, camera: Camera, name: str, value: object):
        with pytest.raises(InputError, match=rf"^{name}: expected a finite number, got "):
            replace(camera, **{name: value})

    @pytest.mark.parametrize("name", ["fx", "fy"])
    @on_every_camera
    def test_focal_lengths_are_not_zero(self, camera: Camera, name: str):
        with pytest.raises(InputError, match=rf"^{name}: expected a focal length other than zero"):
            replace(camera, **{name: 0.0})

    def test_the_full_sphere_is_recognised_by_its_numbers(self):
        default = Equirectangular(64, 32)
        assert Equirectangular(64, 32, *default.intrinsics).wraps
        assert (
            Equirectangular(64, 32, *default.intrinsics).resized(32, 16).intrinsics
            == default.resized(32, 16).intrinsics
        )
        assert not Equirectangular(64, 32, fx=11.0).wraps
        assert not Equirectangular(64, 32, cy=17.0).wraps
