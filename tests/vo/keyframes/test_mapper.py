"""The map: its unit, where its points lie, what leaves it, what ripens, and keyframes that show nothing."""

import gc
import math
import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.depth import InverseRange
from torchvo360.vo import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.cloud import PointCloud
from torchvo360.vo.keyframes.keyframe import Keyframe, make_keyframe
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.window import WindowConfig

CAMERA = Equirectangular(256, 128)
CONFIG = OdometryConfig(blur_px=0.5, window=WindowConfig(keyframes=4))
EYE = torch.eye(4, dtype=torch.float64)
NO_CHANGE = torch.zeros(2, dtype=torch.float64)
LIMIT = CONFIG.map.max_relative_variance


def added(mapper: Mapper, frame: PyramidFrame, T_cam_world: Tensor, affine: Tensor) -> list[Keyframe]:
    mapper.begin_keyframe(frame, T_cam_world, affine)
    return mapper.finish_keyframe()


class Scene:
    """Frames whose poses and ranges are known; the world is the first frame's camera."""

    def __init__(self, world: str = "room", seed: int = 1, *, mask: Tensor | None = None) -> None:
        self.sequence = SyntheticSequence(SyntheticConfig(world=world, width=256, height=128, frames=40, seed=seed))
        self.builder = FrameBuilder(CAMERA, 3, CONFIG.blur_px, mask, CONFIG.saturation)

    def image(self, index: int) -> np.ndarray:
        image = self.sequence.frame(index).image
        assert image is not None
        return image

    def frame(self, index: int, image: np.ndarray | None = None) -> PyramidFrame:
        return self.builder.build(self.image(index) if image is None else image, index, index)

    def T(self, index: int) -> Tensor:
        """T_cam_world."""
        return lie.se3_inverse(self.sequence.pose(index)) @ self.sequence.pose(0)

    def key(self, *, sigma: float = 0.02, unit_m: float = 1.0) -> Keyframe:
        """The first keyframe, with ranges that are off by a share of sigma, and say so."""
        key = make_keyframe(self.frame(0), EYE, self.builder, CONFIG.map)
        noise = torch.randn(len(key.pixel), generator=torch.Generator().manual_seed(0))
        rho = (unit_m / self.sequence.range(0).flatten()[key.pixel] * (1 + sigma * noise)).clamp_min(1e-3)
        key.points = InverseRange(rho, (sigma * rho).square(), torch.ones_like(rho))
        return key

    def known(self, *later: int, unit_m: float = 1.0) -> Mapper:
        """A map from known ranges, with keyframes that were tracked 0.2 deg and 5 mm off."""
        mapper = Mapper.begun(self.key(unit_m=unit_m), self.builder, CONFIG, known=True)
        for index in later:
            T = self.T(index)
            T[:3, 3] /= unit_m
            added(mapper, self.frame(index), off(index, 0.2, 5e-3 / unit_m) @ T, NO_CHANGE)
        return mapper

    def started(self, *later: int) -> Mapper:
        """A map from a start whose ranges and whose direction are off: by a fifth, and by 4 deg."""
        mapper = Mapper.begun(self.key(sigma=0.2), self.builder, CONFIG, known=False)
        mapper.open([(self.frame(4), off(4, 0.3, 0.01) @ self.T(4), NO_CHANGE)])
        for index in later:
            added(mapper, self.frame(index), off(index, 0.2, 5e-3) @ self.T(index), NO_CHANGE)
        return mapper

    def range_error(self, key: Keyframe, unit: float = 1.0) -> Tensor:
        """Relative errors of a reference's ranges, in metres a unit."""
        true = self.sequence.range(key.index).flatten()[key.pixel]
        return (unit / key.points.rho - true).abs() / true


def off(seed: int, angle_deg: float, length: float) -> Tensor:
    w, v = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return lie.se3(lie.so3_exp(w / w.norm() * math.radians(angle_deg)), v / v.norm() * length)


def baseline(mapper: Mapper, i: int, j: int) -> float:
    poses = mapper.poses()
    return float((poses[j][:3, 3] - poses[i][:3, 3]).norm())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


# The unit


@pytest.mark.parametrize("unit_m", [1.0, 0.4])
def test_a_map_from_known_ranges_keeps_their_unit(scene, unit_m):
    mapper = scene.known(6, 12, 18, unit_m=unit_m)
    for index in (6, 12, 18):
        true = lie.se3_inverse(scene.T(index))
        T = mapper.poses()[index]
        assert float((T[:3, 3] * unit_m).norm() / true[:3, 3].norm()) == pytest.approx(1.0, abs=0.015)
        assert float(lie.so3_angle(T[:3, :3].mT @ true[:3, :3]).rad2deg()) < 0.1


def test_known_ranges_pull_back_a_keyframe_that_was_tracked_too_far(scene):
    mapper = scene.known()
    T = scene.T(6)
    T[:3, 3] *= 1.08
    added(mapper, scene.frame(6), T, NO_CHANGE)
    assert baseline(mapper, 0, 6) / float(scene.T(6)[:3, 3].norm()) == pytest.approx(1.0, abs=0.02)


def test_a_start_holds_the_distance_of_its_keyframes_also_when_both_are_gone(scene):
    given = float((off(4, 0.3, 0.01) @ scene.T(4))[:3, 3].norm())
    mapper = scene.started()
    opened = baseline(mapper, 0, 4)
    assert opened == pytest.approx(given, rel=0.005)
    for index in (10, 16, 22, 28, 34):
        added(mapper, scene.frame(index), off(index, 0.2, 5e-3) @ scene.T(index), NO_CHANGE)
        assert baseline(mapper, 0, 4) == pytest.approx(opened, rel=1e-3)
    assert {0, 4} <= set(mapper.settled)
    unit = opened / float(scene.T(4)[:3, 3].norm())
    for index, T in mapper.poses().items():
        true = lie.se3_inverse(scene.T(index))[:3, 3]
        assert float((T[:3, 3] / unit - true).norm()) < 0.004, "1.5 mm at most, on a path of 1.1 m"


# Where the points lie


@pytest.mark.parametrize("place", [0, 1, -1])
def test_the_reference_s_points_lie_where_they_are_seen_the_seam_included(scene, place):
    mapper = scene.known(6, 12, 18)
    key = mapper.reference(place)
    frame = mapper.frames[place]
    assert key.index == frame.index
    assert key.frame is frame
    torch.testing.assert_close(key.T_world_key, mapper.poses()[frame.index])
    assert bool((key.pixel.diff() >= 0).all())
    uv, seen = CAMERA.project(key.ray.T)
    assert bool(seen.all())
    assert torch.equal(key.pixel, uv[:, 1].long().clamp(0, 127) * 256 + uv[:, 0].long().clamp(0, 255))
    torch.testing.assert_close(key.ray.norm(dim=0), torch.ones(len(key.pixel)))
    error = scene.range_error(key)
    column = key.pixel % 256
    seam, pole = (column < 4) | (column >= 252), key.ray[1].abs() > 0.9
    assert int(seam.sum()) > 40
    assert int(pole.sum()) > 40
    for part in (torch.ones_like(seam), seam, pole):
        assert float(error[part].median()) < 0.03
        assert float(error[part].quantile(0.85)) < 0.12
    assert len(key.pixel) > 2000
    torch.testing.assert_close(key.values[0], frame.value(key.ray), rtol=0, atol=1e-6)


def test_every_place_has_its_reference_the_oldest_first(scene):
    mapper = scene.known(6, 12)
    keys = mapper.references()
    assert [key.index for key in keys] == [0, 6, 12]
    assert torch.equal(keys[2].ray, mapper.reference().ray)


@pytest.mark.parametrize("turned", [0, 100], ids=["ahead", "across_the_seam"])
def test_points_behind_a_thing_in_front_are_left_out(scene, turned):
    """A grey sheet before the newest keyframe: no point of the earlier ones is seen through it."""

    def inside(key: Keyframe) -> int:
        row, column = key.pixel // 256, (key.pixel % 256 - turned) % 256
        return int(((row >= 44) & (row < 84) & (column >= 110) & (column < 170)).sum())

    image = scene.image(18).copy()
    image[40:88, (np.arange(104, 176) + turned) % 256] = 255 - image[40:88, (np.arange(104, 176) + turned) % 256]
    plain, covered = scene.known(6, 12), scene.known(6, 12)
    added(plain, scene.frame(18), scene.T(18), NO_CHANGE)
    added(covered, scene.frame(18, image), scene.T(18), NO_CHANGE)
    assert inside(plain.reference()) > 150
    assert inside(covered.reference()) < 0.35 * inside(plain.reference()), "what is as bright by chance stays"
    error = scene.range_error(covered.reference())
    assert float(error.median()) < 0.03


def test_the_reference_knows_another_exposure(scene):
    """A keyframe half as bright: its points are neither hidden nor lost."""
    dim = (scene.image(12) * 0.5).astype(np.uint8)
    mapper = scene.known(6)
    affine = torch.tensor([math.log(0.5), 0.0], dtype=torch.float64)
    added(mapper, scene.frame(12, dim), scene.T(12), affine)
    key = mapper.reference()
    assert len(key.pixel) > 0.9 * len(scene.known(6, 12).reference().pixel)
    a, b = mapper.window.frames[-1].affine.tolist()
    for intensity in (0.2, 0.5, 0.8):
        assert math.exp(a) * intensity + b == pytest.approx(0.5 * intensity, abs=0.01)
    assert float(scene.range_error(key).median()) < 0.03


def test_points_have_one_host_a_cell_and_enough_of_them_are_kept(scene):
    points = scene.known(6, 12).window.points
    assert points is not None
    assert bool((points.host.diff() >= 0).all())
    assert bool((points.inliers >= 1).all())
    for host in range(3):
        own = points.pixel[points.host == host]
        assert 600 < len(own) <= CONFIG.map.points
        assert len(own.unique()) == len(own)


# What leaves


def test_keyframes_leave_the_oldest_first_and_their_poses_and_clouds_stay(scene):
    mapper = Mapper.begun(scene.key(), scene.builder, CONFIG, known=True)
    gone: list[int] = []
    kept: dict[int, tuple[Tensor, PointCloud]] = {}
    for index in (6, 12, 18, 24, 30):
        left = added(mapper, scene.frame(index), scene.T(index), NO_CHANGE)
        gone += [key.index for key in left]
        for key in left:
            assert float(scene.range_error(key).median()) < 0.03
            kept[key.index] = (mapper.poses()[key.index].clone(), mapper.all_clouds()[key.index])
        assert len(mapper.frames) == len(mapper.window.frames) <= CONFIG.window.keyframes
    assert gone == [0, 6]
    assert set(mapper.poses()) == {0, 6, 12, 18, 24, 30}
    assert [key for key in range(40) if mapper.has(key)] == [0, 6, 12, 18, 24, 30]
    for index, (T, cloud) in kept.items():
        assert torch.equal(mapper.poses()[index], T)
        assert torch.equal(mapper.all_clouds()[index].xyz, cloud.xyz)
    T_0 = kept[0][0]
    torch.testing.assert_close(T_0, EYE, rtol=0, atol=1e-6)


def test_every_keyframe_s_cloud_lies_on_the_surfaces_in_its_own_camera(scene):
    mapper = scene.known(6, 12, 18, 24)
    clouds = mapper.all_clouds()
    assert set(clouds) == set(mapper.poses())
    for index, cloud in clouds.items():
        uv, _ = CAMERA.project(cloud.xyz)
        row, column = uv[:, 1].long().clamp(max=127), uv[:, 0].long().clamp(max=255)
        true = scene.sequence.range(index)[row, column]
        error = (cloud.xyz.norm(dim=-1) - true).abs() / true
        assert len(cloud.xyz) > 500
        assert float(error.median()) < 0.03
        assert torch.equal(cloud.rgb, torch.from_numpy(scene.image(index))[row, column])


def test_close_keeps_poses_and_clouds_and_frees_images(scene):
    def images() -> int:
        gc.collect()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return sum(type(each) is PyramidFrame for each in gc.get_objects())

    before = images()
    mapper = scene.known(6, 12, 18, 24)
    assert images() - before == CONFIG.window.keyframes
    poses, clouds = mapper.poses(), mapper.all_clouds()
    mapper.close()
    assert images() == before
    assert mapper.candidates is None
    assert set(mapper.poses()) == set(poses) == {0, 6, 12, 18, 24}
    assert all(torch.equal(mapper.poses()[key], T) for key, T in poses.items())
    assert all(torch.equal(mapper.all_clouds()[key].xyz, cloud.xyz) for key, cloud in clouds.items())
    assert mapper.has(24)
    assert mapper.references() == []


# Candidates


def test_candidates_ripen_in_the_frames_that_follow_and_become_points(scene):
    """The second keyframe is 3 cm from the first, where most ranges cannot be told yet."""
    mapper = Mapper.begun(scene.key(), scene.builder, CONFIG, known=True)
    added(mapper, scene.frame(1), scene.T(1), NO_CHANGE)
    candidates = mapper.candidates
    assert candidates is not None
    assert candidates.frame.index == 1
    waiting = len(candidates.pixel)
    assert waiting > 100
    points = mapper.window.points
    assert points is not None
    before = set(points.pixel[points.host == 1].tolist())
    assert not before & set(candidates.pixel.tolist())
    for index in range(2, 9):
        mapper.observe(scene.frame(index), scene.T(index) @ lie.se3_inverse(scene.T(1)), NO_CHANGE)
    ripe = set(candidates.pixel[candidates.ripe(LIMIT)].tolist())
    assert len(ripe) > 0.5 * waiting
    added(mapper, scene.frame(9), scene.T(9), NO_CHANGE)
    points = mapper.window.points
    assert points is not None
    own = points.pixel[points.host == 1]
    became = torch.tensor([pixel in ripe for pixel in own.tolist()])
    assert int(became.sum()) > 0.6 * len(ripe)
    true = scene.sequence.range(1).flatten()[own[became]]
    error = (1 / points.rho[points.host == 1][became] - true).abs() / true
    assert float(error.median()) < 0.05
    assert mapper.candidates is None or mapper.candidates.frame.index == 9


# Keyframes that show nothing


@pytest.mark.parametrize("kind", ["grey", "black", "white"])
def test_a_keyframe_without_texture_neither_stops_the_map_nor_moves_it(scene, kind):
    value = {"grey": 90, "black": 0, "white": 255}[kind]
    blank = scene.frame(18, np.full((128, 256, 3), value, np.uint8))
    mapper = scene.known(6, 12)
    added(mapper, blank, scene.T(18), NO_CHANGE)
    mapper.observe(scene.frame(19), EYE, NO_CHANGE)
    for index in (24, 30, 36):
        added(mapper, scene.frame(index), scene.T(index), NO_CHANGE)
    added(mapper, scene.frame(39), scene.T(39), NO_CHANGE)
    for index, T in mapper.poses().items():
        assert bool(T.isfinite().all())
        if index != 18:
            assert float((T[:3, 3] - lie.se3_inverse(scene.T(index))[:3, 3]).norm()) < 0.04
    assert len(mapper.all_clouds()[18].xyz) == 0
    assert float(scene.range_error(mapper.reference()).median()) < 0.06


def test_where_all_is_masked_there_are_no_points_and_no_error():
    masked = Scene(mask=torch.zeros(128, 256, dtype=torch.bool))
    mapper = Mapper.begun(masked.key(), masked.builder, CONFIG, known=True)
    added(mapper, masked.frame(6), masked.T(6), NO_CHANGE)
    key = mapper.reference()
    assert len(key.pixel) == 0
    assert all(len(part) == 0 for part in (key.slope, *key.points, *key.values))
    torch.testing.assert_close(mapper.poses()[6], lie.se3_inverse(masked.T(6)))
    assert all(len(cloud.xyz) == 0 for cloud in mapper.all_clouds().values())


def test_masked_pixels_host_no_point():
    mask = torch.ones(128, 256, dtype=torch.bool)
    mask[70:] = False
    masked = Scene(mask=mask)
    points = masked.known(6, 12).window.points
    assert points is not None
    assert len(points) > 500
    assert int(points.pixel.max()) < 70 * 256


def test_equal_input_gives_equal_bits(scene):
    first, second = (scene.started(10, 16, 22) for _ in range(2))
    for key, T in first.poses().items():
        assert torch.equal(T, second.poses()[key])
    for key, cloud in first.all_clouds().items():
        assert torch.equal(cloud.xyz, second.all_clouds()[key].xyz)
    assert torch.equal(first.reference().ray, second.reference().ray)
