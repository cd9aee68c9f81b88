"""Keyframes and the hand-over of their points: exact places, variances, one point a cell, hidden ones left behind."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.depth import InverseRange
from torchvo360.image import equal_area_cells
from torchvo360.vo import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.cloud import join_clouds, to_cloud
from torchvo360.vo.keyframes.keyframe import Keyframe, KeyPoints, MapConfig, carried_keyframe, make_keyframe

CAMERA = Equirectangular(256, 128)
CONFIG = OdometryConfig()
EYE = torch.eye(4, dtype=torch.float64)
GAP = 5


class Scene:
    """A keyframe with true inverse ranges, and a later frame whose pose is known."""

    def __init__(self) -> None:
        sequence = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=GAP + 1, seed=1))
        self.builder = FrameBuilder(CAMERA, 3, 0.7, None, 252 / 255)
        images = [sequence.frame(index).image for index in (0, GAP)]
        self.frames = [self.builder.build(image, i, i) for i, image in enumerate(images) if image is not None]
        self.T_cam_key = lie.se3_inverse(sequence.pose(GAP)) @ sequence.pose(0)
        self.range = sequence.range(0).flatten()
        self.range_later = sequence.range(GAP)

    def key(self) -> Keyframe:
        key = make_keyframe(self.frames[0], EYE, self.builder, CONFIG.map)
        rho = 1 / self.range[key.pixel]
        key.points = InverseRange(rho, (0.1 * rho) ** 2, torch.ones_like(rho))
        return key

    def carry(self, key: KeyPoints, frame: PyramidFrame | None = None, T: Tensor | None = None) -> Keyframe:
        return carried_keyframe(
            key,
            self.frames[1] if frame is None else frame,
            self.T_cam_key if T is None else T,
            torch.zeros(2, dtype=torch.float64),
            self.builder,
            CONFIG.map,
            variance_floor=CONFIG.filter.variance_floor,
            max_difference=CONFIG.track.cutoff,
        )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_a_keyframe_has_one_strong_point_a_cell_in_pixel_order(scene):
    key = make_keyframe(scene.frames[0], EYE, scene.builder, CONFIG.map)
    assert bool((key.pixel.diff() > 0).all())
    assert int(key.pixel[0]) >= 0
    assert int(key.pixel[-1]) < 256 * 128
    cell = equal_area_cells(CAMERA, CONFIG.map.start_points).flatten()[key.pixel]
    assert len(cell.unique()) == len(cell)
    assert float(key.slope.min()) >= CONFIG.map.min_gradient
    torch.testing.assert_close(key.ray.norm(dim=0), torch.ones(len(key.pixel)))
    torch.testing.assert_close(key.values[0], scene.frames[0].image.flatten()[key.pixel], rtol=0, atol=1e-5)
    assert len(key.values) == 3
    assert not bool((key.points.score != 0).any())


def test_masked_and_clipped_pixels_never_become_points(scene):
    mask = torch.ones(128, 256, dtype=torch.bool)
    mask[70:] = False
    builder = FrameBuilder(CAMERA, 3, 0.7, mask, 0.6)
    frame = builder.build(scene.frames[0].colour, 0, 0)
    key = make_keyframe(frame, EYE, builder, CONFIG.map)
    assert int(key.pixel.max()) < 70 * 256
    assert float(key.values[0].max()) < 0.6


def test_moved_points_are_where_the_points_themselves_are(scene):
    key = scene.key()
    p_cam = scene.T_cam_key[:3, :3] @ (key.ray / key.points.rho).double() + scene.T_cam_key[:3, 3:]
    ray, rho = key.moved(scene.T_cam_key)
    torch.testing.assert_close(ray, (p_cam / p_cam.norm(dim=0)).float(), rtol=0, atol=1e-5)
    torch.testing.assert_close(rho, (1 / p_cam.norm(dim=0)).float(), rtol=1e-4, atol=0)


def test_points_at_infinity_turn_with_the_camera_and_stay_at_infinity(scene):
    key = scene.key()
    key.points = key.points._replace(rho=torch.zeros_like(key.points.rho))
    ray, rho = key.moved(scene.T_cam_key)
    torch.testing.assert_close(ray, scene.T_cam_key[:3, :3].float() @ key.ray)
    assert float(rho.abs().max()) == 0
    assert key.mean_flow(scene.T_cam_key) < 1e-6


def test_the_mean_flow_is_the_angle_between_infinity_and_the_points_in_use(scene):
    """In float64 and by another formula; at no motion, and at a half turn without motion, it is 0 and not noise."""
    key = scene.key()
    ray, rho = key.ray.double(), key.points.rho.double()
    turned = scene.T_cam_key[:3, :3] @ ray
    moved = turned + rho * scene.T_cam_key[:3, 3:]
    angle = torch.acos((moved * turned).sum(0) / moved.norm(dim=0) / turned.norm(dim=0))
    assert key.mean_flow(scene.T_cam_key) == pytest.approx(float(angle.mean()), rel=1e-4)
    half_turn = lie.se3(lie.so3_exp(torch.tensor([0.0, math.pi, 0.0]).double()), torch.zeros(3).double())
    assert key.mean_flow(EYE) < 1e-6
    assert key.mean_flow(half_turn) < 1e-6
    nearest = key.points.rho > key.points.rho.median()
    key.points = key.points._replace(score=nearest.float())
    assert key.mean_flow(scene.T_cam_key) == pytest.approx(float(angle[nearest].mean()), rel=1e-4)
    key.points = key.points._replace(score=torch.zeros_like(key.points.score))
    assert key.mean_flow(scene.T_cam_key) == 0.0


def test_the_mean_flow_past_a_point_is_more_than_a_right_angle(scene):
    key = scene.key()
    ray = torch.tensor([[0.0], [0.0], [1.0]])
    one = torch.ones(1)
    key = replace(key, ray=ray, points=InverseRange(one, 0.01 * one, one))
    T = EYE.clone()
    T[:3, 3] = torch.tensor([1e-2, 0.0, -2.0], dtype=torch.float64)
    assert key.mean_flow(T) == pytest.approx(math.pi - math.atan2(1e-2, 1.0), rel=1e-5)


def origins(key: KeyPoints, new: Keyframe, T_cam_key: Tensor) -> Tensor:
    """Return which of the old points the new ones are: by their rays."""
    ray, _ = key.moved(T_cam_key)
    distance, old = torch.cdist(new.ray.T.contiguous(), ray.T.contiguous()).min(1)
    assert float(distance.max()) < 1e-3
    return old


def test_carried_points_lie_at_their_exact_places_with_their_own_variance(scene):
    key = scene.key()
    new = scene.carry(key)
    old = origins(key, new, scene.T_cam_key)
    assert len(old) > 0.5 * len(key.pixel)
    assert len(old.unique()) == len(old)
    ray, rho = key.moved(scene.T_cam_key)
    torch.testing.assert_close(new.ray, ray[:, old], rtol=0, atol=0)
    torch.testing.assert_close(new.points.rho, rho[old], rtol=0, atol=0)
    expected = key.points.variance[old] * (rho[old] / key.points.rho[old]) ** 4
    expected = torch.maximum(expected, CONFIG.filter.variance_floor * rho[old] ** 2)
    torch.testing.assert_close(new.points.variance, expected, rtol=1e-5, atol=0)
    # the scene itself is the judge of the places: the ranges that were rendered there
    true = 1 / scene.range_later.flatten()[new.pixel]
    assert float(((new.points.rho - true) / true).abs().median()) < 0.01
    torch.testing.assert_close(new.T_world_key, lie.se3_inverse(scene.T_cam_key))


def test_the_scaling_of_the_variance_is_that_of_a_small_change(scene):
    key = scene.key()
    eps = 1e-3
    _, rho = key.moved(scene.T_cam_key)
    key.points = key.points._replace(rho=key.points.rho * (1 + eps))
    _, nudged = key.moved(scene.T_cam_key)
    slope = (nudged - rho) / (eps / (1 + eps) * key.points.rho)
    # exact: drho'/drho = (rho'/rho)^3 (1 + rho r . R^T t): (rho'/rho)^2 to first order in rho |t|
    ratio = rho / (key.points.rho / (1 + eps))
    assert float((slope / ratio**2 - 1).abs().median()) < 0.05


def test_no_variance_falls_below_the_floor(scene):
    key = scene.key()
    key.points = key.points._replace(variance=torch.full_like(key.points.rho, 1e-12))
    new = scene.carry(key)
    relative = new.points.variance / new.points.rho**2
    torch.testing.assert_close(relative, torch.full_like(relative, CONFIG.filter.variance_floor), rtol=1e-4, atol=0)


def test_after_the_hand_over_there_is_one_point_a_cell_in_pixel_order(scene):
    new = scene.carry(scene.key())
    assert bool((new.pixel.diff() > 0).all())
    assert int(new.pixel[0]) >= 0
    assert int(new.pixel[-1]) < 256 * 128
    cell = equal_area_cells(CAMERA, CONFIG.map.start_points).flatten()[new.pixel]
    assert len(cell.unique()) == len(cell)
    u, v = CAMERA.pixel_of(*new.ray)
    assert bool(((new.pixel % 256) == (u % 256).long().clamp(max=255)).all())
    assert bool(((new.pixel // 256) == v.long().clamp(max=127)).all())
    assert all(len(part) == len(new.pixel) for part in (*new.points, new.slope, *new.values, new.ray[0]))
    assert all(bool(part.isfinite().all()) for part in (*new.points, new.slope, *new.values, new.ray))


def test_of_several_points_in_a_cell_the_surest_goes_on(scene):
    key = scene.key()
    _, rho = key.moved(EYE)
    sure = torch.arange(len(rho)) % 2 == 0
    key.points = key.points._replace(variance=torch.where(sure, 0.01, 0.04) * rho**2)
    backwards = EYE.clone()
    backwards[:3, 3] = torch.tensor([0.0, 0.0, 0.8])  # points far ahead crowd together
    new = scene.carry(key, frame=replace(scene.frames[1], targets=scene.frames[0].targets), T=backwards)
    relative = new.points.variance / new.points.rho**2
    assert float((relative < 0.02).float().mean()) > 0.5


def test_points_that_are_hidden_in_the_new_frame_stay_behind(scene):
    colour = scene.frames[1].colour.copy()
    colour[:, 60:120] = 255 - colour[:, 60:120]
    covered = scene.builder.build(colour, 1, 1)
    key = scene.key()
    new, free = scene.carry(key, frame=covered), scene.carry(key)
    column, column_free = new.pixel % 256, free.pixel % 256
    inside, inside_free = (column >= 60) & (column < 120), (column_free >= 60) & (column_free < 120)
    assert int(inside.sum()) < 0.5 * int(inside_free.sum())
    old = origins(key, new, scene.T_cam_key)
    assert float((covered.value(new.ray) - key.values[0][old]).abs().max()) <= CONFIG.track.cutoff


def test_points_with_a_low_score_are_not_carried(scene):
    key = scene.key()
    score = torch.where(torch.arange(len(key.pixel)) % 3 == 0, -1.0, 1.0)
    key.points = key.points._replace(score=score)
    new = scene.carry(key)
    assert len(new.pixel) > 100
    assert bool((score[origins(key, new, scene.T_cam_key)] > 0).all())


def test_an_old_keyframe_without_points_in_use_hands_none_over(scene):
    key = scene.key()
    key.points = key.points._replace(score=torch.full_like(key.points.score, -1.0))
    assert len(scene.carry(key).pixel) == 0


def test_a_frame_without_texture_gives_an_empty_keyframe(scene):
    blank = scene.builder.build(scene.frames[0].colour * 0 + 90, 0, 0)
    key = make_keyframe(blank, EYE, scene.builder, CONFIG.map)
    assert len(key.pixel) == 0
    assert len(to_cloud(key.ray, key.points.rho, key.pixel, blank).xyz) == 0
    assert key.mean_flow(scene.T_cam_key) == 0.0


def test_the_cloud_has_the_points_in_their_own_camera_with_their_colours_but_none_at_infinity(scene):
    key = scene.key()
    rho = key.points.rho.clone()
    rho[0], rho[1] = 0.0, 5e-4
    cloud = to_cloud(key.ray, rho, key.pixel, key.frame)
    assert len(cloud.xyz) == len(key.pixel) - 2
    xyz = cloud.xyz.double()
    torch.testing.assert_close(xyz / xyz.norm(dim=-1)[:, None], key.ray[:, 2:].T.double(), rtol=0, atol=1e-5)
    torch.testing.assert_close(cloud.xyz.norm(dim=-1), scene.range[key.pixel[2:]], rtol=1e-4, atol=1e-4)
    expected = torch.from_numpy(scene.frames[0].colour).reshape(-1, 3)[key.pixel[2:]]
    assert torch.equal(cloud.rgb, expected)
    assert len(join_clouds([cloud, cloud]).xyz) == 2 * len(cloud.xyz)
    assert join_clouds([]).xyz.shape == (0, 3)
    assert join_clouds([]).rgb.dtype == torch.uint8


def test_a_cloud_moves_by_a_similarity_its_scale_included(scene):
    key = scene.key()
    cloud = to_cloud(key.ray, key.points.rho, key.pixel, key.frame)
    T = lie.se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.1, 0.5, -0.2], dtype=torch.float64))
    S = T.clone()
    S[:3, :3] *= 2.5
    moved = cloud.moved(S)
    back = (moved.xyz.double() - T[:3, 3]) @ T[:3, :3] / 2.5
    torch.testing.assert_close(back.float(), cloud.xyz, rtol=1e-4, atol=1e-4)
    assert torch.equal(moved.rgb, cloud.rgb)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("points", 99),
        ("start_points", 99),
        ("max_keyframe_gap", 0),
        ("min_gradient", 0.0),
        ("keyframe_flow_deg", math.inf),
        ("keyframe_flow_deg", 0.0),
        ("max_difference", -1.0),
        ("max_keyframe_gain", 0.0),
        ("min_visible", 1.1),
    ],
)
def test_unusable_settings_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        MapConfig(**{name: value})
