"""The rendered world: exact ranges, one colour for one point, no alias."""

import math

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError, ShapeError
from torchvo360.data.synthetic import WORLDS, World, make_world
from torchvo360.data.synthetic.geometry import Solids
from torchvo360.data.synthetic.motion import UPRIGHT
from torchvo360.data.synthetic.rays import CameraRays
from torchvo360.lie import se3, se3_inverse, so3_exp

SPHERE = Equirectangular(256, 128)
PLANE = Pinhole(160, 120, 90.0, 85.0, 78.0, 61.5)
CAMERAS = pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "plane"])


@pytest.fixture(scope="module")
def worlds() -> dict[str, World]:
    return {name: make_world(name, seed=4) for name in WORLDS}


def pose_near(world: World, *, seed: int, tilt: float = 0.3, shift: float = 0.15) -> torch.Tensor:
    """Return a random pose T_world_cam close to the middle of the walkway's first point."""
    generator = torch.Generator().manual_seed(seed)
    w = torch.rand(3, generator=generator, dtype=torch.float64) * 2 - 1
    t = (torch.rand(3, generator=generator, dtype=torch.float64) * 2 - 1) * shift
    (x, y), (a, _) = world.walkway.centre, world.walkway.radii
    at = torch.tensor([x + a, y, world.walkway.eye_height], dtype=torch.float64)
    return se3(so3_exp(tilt * w) @ UPRIGHT, at + t)


def look_up(image: torch.Tensor, uv: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Sample [C, H, W] at pixels, with the seam."""
    border = int(camera.wraps)
    image = F.pad(image[None], (border, border, 0, 0), mode="circular") if camera.wraps else image[None]
    size = torch.tensor([image.shape[-1], image.shape[-2]])
    grid = ((uv + torch.tensor([border, 0])) / size * 2 - 1)[None].to(image.dtype)
    return F.grid_sample(image, grid, align_corners=False, padding_mode="border")[0]


def reproject(world: World, camera: Camera, T_world_ref: torch.Tensor, T_world_tgt: torch.Tensor):
    """Return, on the reference, its colour and expected range in the target, and what the target shows there."""
    image, reach = world.render(camera, torch.stack([T_world_ref, T_world_tgt]))
    T_tgt_ref = se3_inverse(T_world_tgt) @ T_world_ref
    # a point at infinity keeps its direction: the ray times range, in the limit
    y = (
        camera.ray_grid(dtype=torch.float64) @ T_tgt_ref[:3, :3].mT
        + (1 / reach[0].double())[..., None] * T_tgt_ref[:3, 3]
    )
    uv, valid = camera.project(y)
    rho_expected = 1 / reach[0].double() / camera.scale(y)
    rho_seen = look_up(1 / reach[1][None].double(), uv, camera)[0]
    return image[0], look_up(image[1], uv, camera), rho_expected, rho_seen, valid


@CAMERAS
def test_range_in_an_empty_box_is_the_distance_to_the_nearest_plane_ahead(camera):
    half = torch.tensor([3.0, 2.0, 1.5])
    shell = Solids(torch.zeros(1, 3), half[None], torch.tensor([[1.0, 0.0]]), torch.tensor([False]), open_above=False)
    origin = torch.tensor([0.7, -0.4, 0.3])
    rays = CameraRays.of(camera)
    reach, met = shell.cast(origin, rays.tiles.ray, rays.tiles.axis, rays.tiles.angle)
    ray = camera.ray_grid(dtype=torch.float64)
    planes = torch.cat([(half - origin) / ray, (-half - origin) / ray], -1)
    expected = torch.where(planes > 0, planes, torch.inf).amin(-1)
    torch.testing.assert_close(rays.image(reach).double(), expected, rtol=2e-6, atol=0)
    assert not met.any()


@pytest.mark.parametrize("name", WORLDS)
@CAMERAS
def test_range_ends_on_a_surface_and_nothing_lies_before_it(name, camera, worlds):
    world = worlds[name]
    T_world_cam = pose_near(world, seed=1)
    _, reach = world.render(camera, T_world_cam)
    ray = camera.ray_grid(dtype=torch.float64) @ T_world_cam[:3, :3].mT
    hit = reach.isfinite()
    ray, end = ray[hit][::7], reach[hit].double()[::7]
    for share in (0.1, 0.3, 0.5, 0.7, 0.9, 0.99):
        assert world.clearance(T_world_cam[:3, 3] + ray * (share * end)[:, None]).min() > -1e-5
    torch.testing.assert_close(
        world.clearance(T_world_cam[:3, 3] + ray * end[:, None]), torch.zeros_like(end), atol=2e-5, rtol=0
    )


@pytest.mark.parametrize("name", WORLDS)
@CAMERAS
def test_solids_left_out_for_a_group_of_rays_are_hit_by_none_of_them(name, camera, worlds):
    world = worlds[name]
    rays = CameraRays.of(camera).tiles
    for seed in range(3):
        T = pose_near(world, seed=seed, tilt=1.5, shift=0.4).float()
        ray, axis = torch.einsum("ij,jgr->igr", T[:3, :3], rays.ray), T[:3, :3] @ rays.axis
        reach, met = world.solids.cast(T[:3, 3], ray, axis, rays.angle)
        all_reach, all_met = world.solids.cast(T[:3, 3], ray, axis, torch.full_like(rays.angle, math.pi))
        assert torch.equal(reach, all_reach)
        assert torch.equal(met, all_met)


def test_a_ray_along_the_axis_of_a_solid_meets_its_top_or_passes_beside_it():
    solids = Solids(
        torch.tensor([[0.0, 0, 1.5], [1, 0, 0.5], [-1, 0, 0.25]]),
        torch.tensor([[3.0, 3, 1.5], [0.3, 0.3, 0.5], [0.2, 0.4, 0.25]]),
        torch.tensor([[1.0, 0.0]]).expand(3, 2),
        torch.tensor([False, True, False]),
        open_above=False,
    )
    down = torch.tensor([0.0, 0.0, -1.0])[:, None, None]
    for x, expected in ((1.0, 1.0), (1.29, 1.0), (1.31, 2.0), (-1.0, 1.5), (-1.21, 2.0)):
        reach, _ = solids.cast(torch.tensor([x, 0.0, 2.0]), down, down[:, 0], torch.tensor([0.01]))
        assert reach.item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", WORLDS)
@CAMERAS
@pytest.mark.parametrize("seed", [0, 1])
def test_a_point_reprojects_into_another_view_with_its_range_and_its_colour(name, camera, seed, worlds):
    world = worlds[name]
    T_world_ref = pose_near(world, seed=seed, tilt=1.0)
    T_ref_tgt = se3(
        so3_exp(torch.tensor([0.03, -0.05, 0.02], dtype=torch.float64)), torch.tensor([0.04, 0.02, -0.05]).double()
    )
    ref, tgt, rho_expected, rho_seen, valid = reproject(world, camera, T_world_ref, T_world_ref @ T_ref_tgt)
    assert valid.float().mean() > 0.8
    areas = {"all": valid}
    if camera.wraps:
        v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        areas["seam"] = (u < 6) | (u >= camera.width - 6)
        areas["poles"] = (v < 8) | (v >= camera.height - 8)
    for area, chosen in areas.items():
        colour = (ref - tgt).abs().mean(0)[chosen]
        assert colour.median() < 0.01, area
        assert colour.quantile(0.9) < 0.06, area
        # the look-up interpolates the range, which bends within a pixel on slanted walls
        error = (rho_expected - rho_seen).abs()[chosen]
        assert error.median() < 5e-4, area
        assert (error < 0.01).float().mean() > 0.9, area


@pytest.mark.parametrize("name", WORLDS)
def test_pinhole_and_panorama_at_one_pose_see_the_same_points_and_colours(name, worlds):
    world = worlds[name]
    T_world_cam = pose_near(world, seed=2, tilt=0.6)
    fine = Equirectangular(768, 384)  # 0.47 deg a pixel; the pinhole's 0.48 to 0.64
    panorama, distance = world.render(fine, T_world_cam)
    camera = Pinhole(128, 96, 120.0, 120.0, 64.0, 48.0)
    image, depth = world.render(camera, T_world_cam)
    ray = camera.ray_grid(dtype=torch.float64)
    uv, _ = fine.project(ray)
    rho = 1 / (depth.double() * torch.linalg.vector_norm(ray, dim=-1))
    error = (look_up(1 / distance[None].double(), uv, fine)[0] - rho).abs()
    assert error.median() < 5e-4
    assert (error < 0.01).float().mean() > 0.9
    colour = (look_up(panorama, uv, fine) - image).abs().mean(0)
    assert colour.median() < 0.015
    assert colour.quantile(0.9) < 0.08


def test_sky_is_at_infinity_above_and_keeps_its_colour_when_the_camera_walks(worlds):
    world = worlds["courtyard"]
    T = pose_near(world, seed=3, tilt=0.0)
    moved = T.clone()
    moved[:2, 3] += 0.5
    image, reach = world.render(SPHERE, torch.stack([T, moved]))
    up = -SPHERE.ray_grid()[..., 1]
    sky = reach.isinf()
    assert sky[:, up > 0.95].float().mean() > 0.9
    assert not sky[:, up <= 0].any()
    both = sky.all(0)
    assert both.float().mean() > 0.2
    # pixels that walls share with the sky are left out
    assert (image[0] - image[1]).abs().amax(0)[both].quantile(0.9) < 1e-6
    assert worlds["room"].render(SPHERE, pose_near(worlds["room"], seed=3))[1].isfinite().all()


@pytest.mark.parametrize("name", WORLDS)
def test_a_small_image_is_the_mean_of_a_large_one(name, worlds):
    """What an aliased look-up breaks: colours at a coarse pixel are the mean over it."""
    world = worlds[name]
    T = pose_near(world, seed=5)
    coarse, _ = world.render(Equirectangular(256, 128), T)
    fine, _ = world.render(Equirectangular(1024, 512), T)
    difference = (F.avg_pool2d(fine, 4) - coarse).abs().mean(0)
    assert difference.median() < 0.02
    assert difference.quantile(0.95) < 0.08


@pytest.mark.parametrize("name", WORLDS)
def test_there_is_structure_at_every_pyramid_level_and_no_black_or_white(name, worlds):
    image, _ = worlds[name].render(Equirectangular(512, 256), pose_near(worlds[name], seed=6))
    assert (image.amax(0) < 0.05).float().mean() < 0.01
    assert (image.amin(0) > 0.999).float().mean() < 0.01
    level = image.mean(0)[None]
    for _ in range(5):
        inner = level[:, level.shape[1] // 4 : -level.shape[1] // 4]
        assert inner.diff(dim=-1).abs().mean() > 0.008
        level = F.avg_pool2d(level, 2)


@CAMERAS
@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_any_batch_of_poses_renders_and_each_pose_alone_gives_the_same(camera, batch, worlds):
    camera = camera.resized(32, 16)
    world = worlds["room"]
    poses = [pose_near(world, seed=k) for k in range(max(1, math.prod(batch)))]
    T = torch.stack(poses)[: math.prod(batch)].view(*batch, 4, 4)
    image, reach = world.render(camera, T)
    assert image.shape == (*batch, 3, 16, 32)
    assert reach.shape == (*batch, 16, 32)
    if math.prod(batch):
        alone, alone_reach = world.render(camera, poses[0])
        assert torch.equal(image.reshape(-1, 3, 16, 32)[0], alone)
        assert torch.equal(reach.reshape(-1, 16, 32)[0], alone_reach)


def test_equal_seeds_give_equal_worlds_and_other_seeds_other_ones(worlds):
    T = pose_near(worlds["room"], seed=0)
    same, _ = make_world("room", seed=4).render(SPHERE, T)
    other, _ = make_world("room", seed=5).render(SPHERE, T)
    image, _ = worlds["room"].render(SPHERE, T)
    assert torch.equal(image, same)
    assert (image - other).abs().mean() > 0.05


def test_movers_move_and_everything_else_stands(worlds):
    still, moving = worlds["room"], make_world("room", seed=4, moving_objects=2)
    T = pose_near(still, seed=0)
    _, before = still.render(SPHERE, T)
    image, reach = zip(*(moving.render(SPHERE, T, t=t) for t in (0.0, 1.2)), strict=True)
    covered = (reach[0] < before) | (reach[1] < before)
    assert torch.equal(reach[0][~covered], before[~covered])
    assert torch.equal(reach[1][~covered], before[~covered])
    assert 0.005 < covered.float().mean() < 0.3
    assert (image[0] - image[1]).abs().mean(0)[covered].mean() > 0.05
    assert (reach[0] != reach[1]).any()
    assert torch.equal(still.render(SPHERE, T, t=1.2)[1], before)


def test_a_panorama_is_worn_by_the_walls_and_seen_unchanged_from_its_centre(tmp_path):
    lon, lat = torch.meshgrid(torch.linspace(0, math.tau, 256), torch.linspace(0, math.pi, 128), indexing="xy")
    picture = 0.5 + 0.4 * torch.stack([(3 * lon).sin(), (2 * lon).cos(), (4 * lat).sin()]) * lat.sin()
    path = tmp_path / "panorama.png"
    rgb = (picture.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    world = make_world("room", seed=4, panorama=path)
    at = torch.tensor(world.surfaces.panorama_centre, dtype=torch.float64)
    image, _ = world.render(Equirectangular(256, 128), se3(UPRIGHT, at))
    assert (image - picture).abs().mean(0).median() < 0.01
    sky = make_world("courtyard", seed=4, panorama=path)
    image, reach = sky.render(Equirectangular(256, 128), se3(UPRIGHT, at))
    assert (image - picture).abs().mean(0)[reach.isinf()].quantile(0.9) < 0.02


def test_the_callers_mistakes_are_named(worlds, tmp_path):
    with pytest.raises(InputError, match="world: expected one of room, pillars, courtyard, field, got 'cave'"):
        make_world("cave")
    with pytest.raises(InputError, match="panorama: expected the path of a readable image, got"):
        make_world("room", panorama=tmp_path / "none.png")
    outside = torch.eye(4, dtype=torch.float64)
    outside[0, 3] = 40.0
    with pytest.raises(InputError, match="T_world_cam: expected a position inside the world room"):
        worlds["room"].render(SPHERE, outside)
    with pytest.raises(ShapeError, match="T_world_cam: expected shape"):
        worlds["room"].render(SPHERE, torch.eye(3))
