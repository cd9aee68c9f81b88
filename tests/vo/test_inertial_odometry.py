"""With an IMU a single camera knows metres and the vertical, and goes on where its images fail."""

import math
from copy import copy, deepcopy
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.data.registration import similarity_from_points
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.inertial import ImuSamples, ImuSensor
from torchvo360.vo import FrameEstimate, OdometryConfig, OdometryResult, State, VisualOdometry
from torchvo360.vo.inertial import InertialLink

WALK = {"width": 256, "height": 128, "frames": 200, "imu_rate": 200.0}
PINHOLE = {"camera": "pinhole", "width": 320, "height": 240}
CONFIG = OdometryConfig(blur_px=0.5)
DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)


class Journey:
    """A synthetic walk with an IMU, gone through."""

    def __init__(self, sensor: ImuSensor | None = None, *, config: OdometryConfig = CONFIG, **settings: object) -> None:
        self.sequence = SyntheticSequence(SyntheticConfig(**{**WALK, **settings}))  # type: ignore[arg-type]
        sensor = self.sequence.imu if sensor is None else sensor
        self.odometry = VisualOdometry(self.sequence.camera, deepcopy(config), imu=sensor, rig=self.sequence.rig)
        with torch.inference_mode():
            self.online: list[FrameEstimate] = [self.odometry.step(frame) for frame in self.sequence]
            self.result: OdometryResult = self.odometry.finish()

    @property
    def scale_error(self) -> float:
        return abs(evaluate(self.result.trajectory, self.sequence.truth).scale - 1)

    @property
    def gravity_error_deg(self) -> float:
        """Against the vertical as the first camera truly sees it."""
        assert self.result.gravity is not None
        gravity = torch.tensor(self.result.gravity, dtype=torch.float64)
        down = self.sequence.pose(0)[:3, :3].mT @ DOWN
        return math.degrees(math.acos(min(1.0, float(down @ gravity / gravity.norm()))))

    def errors_m(self) -> Tensor:
        """Of all final positions, in metres: without a scale of one's own."""
        found, true = self.result.trajectory.positions, self.sequence.truth.positions
        T = similarity_from_points(found, true, with_scale=False)
        assert T is not None
        return torch.linalg.vector_norm(found @ T[:3, :3].mT + T[:3, 3] - true, dim=-1)


@pytest.mark.parametrize(
    "settings",
    [{"world": "room", "seed": 0}, {"world": "courtyard", "seed": 5}, {"world": "room", "seed": 4, **PINHOLE}],
    ids=["room", "courtyard", "pinhole"],
)
def test_a_single_camera_knows_metres_and_the_vertical(settings):
    journey = Journey(**settings)
    assert journey.scale_error < 0.015
    assert journey.gravity_error_deg < 0.5
    assert float(journey.errors_m().square().mean().sqrt()) < 0.006 * journey.sequence.truth.path_length
    assert journey.result.maps == 1


@pytest.fixture(scope="module")
def dark() -> tuple[Journey, list[int]]:
    """A walk with two seconds of black images, and their places."""
    journey = Journey(world="pillars", seed=1, blackout_s=2.0, frames=210)
    return journey, [at for at, estimate in enumerate(journey.online) if estimate.reason == "bad_frame_black"]


def test_two_seconds_without_images_are_bridged_to_a_few_centimetres(dark):
    journey, black = dark
    assert len(black) == 60
    assert {journey.online[at].state for at in black} == {State.WEAK}
    assert float(journey.errors_m()[black].max()) < 0.05
    assert journey.result.maps == 1
    assert journey.online[black[-1] + 1].state == State.TRACKING
    # As they were given out, too: by how far the camera went meanwhile.
    gone = journey.online[black[-1]].T_world_cam[:3, 3] - journey.online[black[0]].T_world_cam[:3, 3]
    true = journey.sequence.pose(black[-1])[:3, 3] - journey.sequence.pose(black[0])[:3, 3]
    assert abs(float(gone.norm() - true.norm())) < 0.1


def test_smoothing_leaves_the_bridge_that_the_imu_built(dark):
    journey, black = dark
    plain = float(journey.errors_m()[black].max())
    smooth = copy(journey)
    smooth.odometry.config.smooth = True
    smooth.result = journey.odometry.finish()
    assert not torch.equal(smooth.result.trajectory.T_world_cam, journey.result.trajectory.T_world_cam)
    assert float(smooth.errors_m()[black].max()) < plain + 0.01


def test_a_rig_keeps_its_metre_beside_an_imu():
    both = Journey(world="room", seed=0, frames=120, stereo_baseline=0.2, stereo_axis="y")
    assert both.result.gravity is not None
    assert both.result.metric
    assert both.gravity_error_deg < 0.5
    assert both.scale_error < 0.005


def test_a_camera_that_stands_does_not_grow_slow_beside_its_imu():
    """What was measured since the newest keyframe is kept, and every frame adds its own part."""
    sequence = SyntheticSequence(SyntheticConfig(**{**WALK, "world": "room", "seed": 0}))
    imu = sequence.imu
    assert imu is not None
    link = InertialLink(imu, CONFIG.inertial, 4 / 255)
    bias = torch.zeros(6, dtype=torch.float64)
    times = sequence.truth.t_ns.tolist()
    for at in range(11, 100):
        kept = link._since_key(times[10], times[at], bias)
    whole = link.between([times[10], times[99]], bias)
    torch.testing.assert_close(kept.dR, whole.dR, rtol=0, atol=1e-5)
    torch.testing.assert_close(kept.dp, whole.dp, rtol=0, atol=1e-4)


def test_a_second_without_samples_is_survived():
    journey = Journey(world="room", seed=3, imu_gap_s=1.0)
    assert journey.scale_error < 0.015
    assert journey.result.maps == 1
    assert {estimate.state for estimate in journey.online} <= {State.INITIALISING, State.TRACKING}


def test_an_offset_of_the_clocks_is_found():
    journey = Journey(world="pillars", seed=1, imu_offset_ms=-40.0)
    assert journey.result.imu_offset_s == pytest.approx(-0.04, abs=1e-3)
    assert journey.scale_error < 0.015


def test_samples_that_end_early_leave_the_images_to_themselves():
    sequence = SyntheticSequence(SyntheticConfig(**{**WALK, "world": "room", "seed": 0, "frames": 60}))
    whole = sequence.imu
    assert whole is not None
    few = ImuSamples(*(part[:60].clone() for part in (whole.samples.t_ns, whole.samples.gyro, whole.samples.accel)))
    journey = Journey(replace(whole, samples=few), world="room", seed=0, frames=60)
    assert journey.result.gravity is None
    assert {estimate.state for estimate in journey.online} == {State.INITIALISING, State.TRACKING}
    assert evaluate(journey.result.trajectory, journey.sequence.truth).ate_percent < 0.2


def test_a_walk_that_tells_no_scale_is_left_without_one():
    """A camera that only turns: nothing may be made up."""
    journey = Journey(world="room", seed=0, motion="rotation", frames=90)
    assert journey.result.gravity is None


def test_the_answer_is_the_same_every_time():
    first, second = (Journey(world="room", seed=0, frames=90) for _ in range(2))
    assert torch.equal(first.result.trajectory.T_world_cam, second.result.trajectory.T_world_cam)
    assert first.result.gravity == second.result.gravity
    assert first.result.gravity is not None


def test_images_of_an_earlier_place_are_found_there_in_metres():
    """The images jump back, which the IMU does not: they are found in an earlier keyframe, whose scale goes on."""
    sequence = SyntheticSequence(SyntheticConfig(**{**WALK, "world": "room", "seed": 0, "frames": 150}))
    odometry = VisualOdometry(
        sequence.camera, replace(CONFIG, inertial=replace(CONFIG.inertial, max_bridge_s=0.2)), imu=sequence.imu
    )
    frames = list(sequence)
    order = [*range(110), *range(60, 80)]
    estimates = []
    for place, number in enumerate(order):
        frame = replace(frames[number], index=place, t_ns=frames[place].t_ns)
        estimates.append(odometry.step(frame))
    result = odometry.finish()
    assert any(estimate.reason == "earlier_keyframe" for estimate in estimates)
    last, true = result.trajectory.T_world_cam[-1], sequence.pose(0)
    moved = lie.se3_inverse(true) @ sequence.pose(order[-1])
    assert float((last[:3, 3] - moved[:3, 3]).norm()) < 0.1
