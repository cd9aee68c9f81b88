"""A start by a depth sensor: at once, in metres, without corners, and later keyframes take its ranges too."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchvo360 import lie
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.vo import SENSOR, OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.fresh import fresh_points
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.start.begin import Starter

CONFIG = OdometryConfig(blur_px=0.5)
SETTINGS = SyntheticConfig(camera="pinhole", width=240, height=180, frames=12, seed=2, depth_noise=0.01)


def add_keyframe(mapper: Mapper, frame: PyramidFrame, T_cam_world: torch.Tensor, affine: torch.Tensor) -> None:
    mapper.begin_keyframe(frame, T_cam_world, affine)
    mapper.finish_keyframe()


class Walk:
    """Frames with depth whose poses and ranges are known."""

    def __init__(self) -> None:
        self.sequence = SyntheticSequence(SETTINGS)
        self.builder = FrameBuilder(self.sequence.camera, 3, CONFIG.blur_px, None, CONFIG.saturation)

    def frame(self, index: int, *, known: slice | None = None, depth: bool = True) -> PyramidFrame:
        """Return a frame whose depth is known in some columns."""
        given = self.sequence.frame(index)
        assert given.image is not None
        assert given.depth is not None
        shown = given.depth.copy() if depth else None
        if shown is not None and known is not None:
            part = np.zeros_like(shown)
            part[:, known] = shown[:, known]
            shown = part
        return self.builder.build(given.image, index, index, depth=shown)

    def starter(self) -> Starter:
        return Starter(self.builder, CONFIG, torch.Generator().manual_seed(0), None, None)

    def T_cam_key(self, index: int, key: int = 0) -> torch.Tensor:
        return lie.se3_inverse(self.sequence.pose(index)) @ self.sequence.pose(key)

    def true_rho(self, index: int, pixel: torch.Tensor) -> torch.Tensor:
        camera = self.sequence.camera
        distance = self.sequence.range(index) * camera.ray_grid().norm(dim=-1)
        return (1 / distance).flatten()[pixel]


@pytest.fixture(scope="module")
def walk() -> Walk:
    return Walk()


def test_the_first_frame_is_a_map_in_metres(walk):
    T_world_ref = lie.se3_exp(torch.tensor([3.0, -1.0, 2.0, 0.2, 1.0, 0.1], dtype=torch.float64))
    starter = walk.starter()
    starter.restart(T_world_ref, 5.0)
    begun = starter.add(walk.frame(0))
    assert begun is not None
    assert begun.reason == SENSOR
    assert begun.mapper.metric
    assert begun.T_key_cam == {}
    assert not starter.settling
    assert not starter.confirming
    torch.testing.assert_close(begun.newest.T_world_key, T_world_ref)
    key = begun.newest
    used = key.trusted(CONFIG.map.max_relative_variance)
    off = (key.points.rho / walk.true_rho(0, key.pixel) - 1)[used]
    assert float(off.abs().median()) < 0.012
    assert float(off.abs().max()) < 0.1, "nothing from edges"
    points = begun.mapper.window.points
    assert points is not None
    assert (points.information > 0).all()


def test_points_that_the_sensor_does_not_know_are_left_to_the_images(walk):
    begun = walk.starter().add(walk.frame(0, known=slice(0, 120)))
    assert begun is not None
    column = begun.newest.pixel % 240
    used = begun.newest.trusted(CONFIG.map.max_relative_variance)
    assert used[column < 110].float().mean() > 0.5
    assert not used[column >= 120].any()


@pytest.mark.parametrize("known", [slice(0, 0), slice(0, 2)])
def test_too_little_depth_waits_for_the_corners(walk, known):
    starter = walk.starter()
    assert starter.add(walk.frame(0, known=known)) is None
    assert starter.add(walk.frame(1, known=known)) is None
    assert starter.reason == "low_parallax"


def test_frames_that_waited_for_depth_are_found_by_it_and_the_first_stays_the_world(walk):
    starter = walk.starter()
    for index in range(4):
        assert starter.add(walk.frame(index, depth=False)) is None
    begun = starter.add(walk.frame(4))
    assert begun is not None
    assert sorted(begun.T_key_cam) == [0, 1, 2, 3]
    for index, T_key_cam in begun.T_key_cam.items():
        away = lie.se3_log(T_key_cam @ walk.T_cam_key(index, key=4))
        assert float(away[:3].norm()) < 0.01
        assert float(away[3:].norm().rad2deg()) < 0.2
    torch.testing.assert_close(begun.newest.T_world_key, lie.se3_inverse(walk.T_cam_key(4)), rtol=0, atol=0.01)


def test_a_keyframe_takes_the_sensors_ranges_and_traces_the_rest(walk):
    begun = walk.starter().add(walk.frame(0))
    assert begun is not None
    mapper = begun.mapper
    half = slice(0, 120)
    for index in (5, 10):
        nothing = torch.zeros(2, dtype=torch.float64)
        T_cam_world = walk.T_cam_key(index)
        add_keyframe(mapper, walk.frame(index, known=half if index == 10 else None), T_cam_world, nothing)
    points = mapper.window.points
    assert points is not None
    own = points.take((points.host == 2).nonzero()[:, 0])
    measured, column = own.information > 0, own.pixel % 240
    assert measured.sum() > 100
    assert not measured[column >= 120].any()
    assert (~measured[column >= 120]).sum() > 30, "traced"
    off = (own.rho / walk.true_rho(10, own.pixel) - 1).abs()
    assert float(off[measured].median()) < 0.006, "better than the sensor, by the images"
    assert float(off[~measured].median()) < 0.02


def test_in_a_map_of_another_unit_the_sensor_has_no_say(walk):
    begun = walk.starter().add(walk.frame(0))
    assert begun is not None
    mapper = begun.mapper
    add_keyframe(mapper, walk.frame(5), walk.T_cam_key(5), torch.zeros(2, dtype=torch.float64))
    rest = (mapper.window, 1, [0], walk.frame(5), walk.builder, CONFIG)
    foreign, own = fresh_points(*rest), fresh_points(*rest, metric=True)
    assert (foreign.points.information == 0).all()
    assert own.points.information.max() > 0
    blind = fresh_points(*rest[:3], replace(rest[3], sensed=None), *rest[4:], metric=True)
    assert torch.equal(blind.points.rho, foreign.points.rho)
