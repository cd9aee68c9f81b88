"""What is taken from a depth image: inverse ranges with the sensor's noise, and nothing on edges."""

import numpy as np
import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.vo.frame import FrameBuilder
from torchvo360.vo.sensor import SensorConfig, read_depth

CAMERA = Pinhole(8, 6, 5.0, 5.0, 4.0, 3.0)
CPU = torch.device("cpu")


def depth_of(value: float, shape: tuple[int, int] = (6, 8)) -> np.ndarray:
    return np.full(shape, value, np.float32)


def test_the_variance_is_that_of_calibration_and_of_a_disparity():
    sensed = read_depth(depth_of(2.0), CAMERA, SensorConfig(relative=0.01, constant=0.003), CPU)
    assert sensed is not None
    torch.testing.assert_close(sensed.rho, torch.full((6, 8), 0.5))
    torch.testing.assert_close(sensed.variance, torch.full((6, 8), 0.005**2 + 0.003**2))


@pytest.mark.parametrize("nothing", [None, 0.0, -1.0, np.nan, np.inf, -np.inf, 1e-45])
def test_a_depth_image_that_knows_nothing_is_none(nothing):
    depth = None if nothing is None else depth_of(nothing)
    assert read_depth(depth, CAMERA, SensorConfig(), CPU) is None


def test_both_sides_of_an_edge_and_what_lies_between_are_not_used():
    depth = depth_of(2.0)
    depth[:, 4] = 2.7
    depth[:, 5:] = 4.0
    sensed = read_depth(depth, CAMERA, SensorConfig(), CPU)
    assert sensed is not None
    used = torch.isfinite(sensed.variance)
    assert used.all(0).tolist() == [True, True, True, False, False, False, True, True]
    assert not used[:, 3:6].any()
    assert (sensed.rho[:, 3:6] == 0).all()


def test_neighbours_that_are_not_known_contradict_nothing():
    depth = depth_of(2.0)
    depth[2, 3], depth[3, 3] = 0.0, np.nan
    sensed = read_depth(depth, CAMERA, SensorConfig(), CPU)
    assert sensed is not None
    assert int(torch.isinf(sensed.variance).sum()) == 2
    alone = np.zeros((6, 8), np.float32)
    alone[2, 3] = 2.0
    assert read_depth(alone, CAMERA, SensorConfig(), CPU) is not None


def test_a_panoramas_edges_are_found_across_its_seam():
    depth = depth_of(2.0, (8, 16))
    depth[:, 12:] = 4.0
    sensed = read_depth(depth, Equirectangular(16, 8), SensorConfig(), CPU)
    assert sensed is not None
    used = torch.isfinite(sensed.variance)[3]
    assert used.nonzero()[:, 0].tolist() == [*range(1, 11), 13, 14]


def test_points_have_distances_along_their_unit_rays():
    builder = FrameBuilder(CAMERA, 1, 0.5, None, 1.0)
    frame = builder.build(np.zeros((6, 8, 3), np.uint8), 0, 0, depth=depth_of(2.0))
    pixel = torch.arange(48)
    rho, variance = builder.sensed(frame, pixel)
    torch.testing.assert_close((builder.rays(pixel) / rho)[2], torch.full((48,), 2.0))
    torch.testing.assert_close(variance / rho.square(), torch.full((48,), 0.01**2 + 0.003**2))
    rho, variance = builder.sensed(builder.build(np.zeros((6, 8, 3), np.uint8), 1, 1), pixel)
    assert torch.isinf(variance).all()
    assert (rho == 0).all()


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"relative": -0.1}, "relative: expected"),
        ({"constant": float("nan")}, "constant: expected"),
        ({"edge": 0.0}, "edge: expected"),
        ({"relative": 0.0, "constant": 0.0}, "expected one of them above 0"),
    ],
)
def test_impossible_noise_is_refused_by_name(settings, complaint):
    with pytest.raises(InputError, match=complaint):
        SensorConfig(**settings)
