"""A batch of odometries: what each would give alone, whatever the others do."""

import pytest
import torch

from torchvo360 import OdometryBatch, VisualOdometry
from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.vo import OdometryConfig, OdometryResult

SIZES = {"room": (256, 128, 30), "pillars": (192, 96, 40), "courtyard": (256, 128, 20)}


def sequences() -> list[SyntheticSequence]:
    return [
        SyntheticSequence(SyntheticConfig(world=world, width=width, height=height, frames=frames, seed=1))
        for world, (width, height, frames) in SIZES.items()
    ]


def odometries() -> list[VisualOdometry]:
    return [VisualOdometry(sequence.camera, OdometryConfig(blur_px=0.5)) for sequence in sequences()]


def alone() -> list[OdometryResult]:
    results = []
    for odometry, sequence in zip(odometries(), sequences(), strict=True):
        for frame in sequence:
            odometry.step(frame)
        results.append(odometry.finish())
    return results


@torch.inference_mode()
def test_results_are_those_of_single_runs():
    expected = alone()
    by_run = OdometryBatch(odometries()).run(sequences())
    stepped, given = OdometryBatch(odometries(), workers=2), [list(sequence) for sequence in sequences()]
    for k in range(max(map(len, given))):
        estimates = stepped.step([frames[k] if k < len(frames) else None for frames in given])
        assert [estimate is None for estimate in estimates] == [k >= len(frames) for frames in given]
    for single, run, step in zip(expected, by_run, stepped.finish(), strict=True):
        for other in (run, step):
            assert torch.equal(single.trajectory.T_world_cam, other.trajectory.T_world_cam)
            assert torch.equal(single.points.xyz, other.points.xyz)
            assert [f.state for f in single.frames] == [f.state for f in other.frames]


@torch.inference_mode()
def test_a_refused_frame_keeps_the_others_from_nothing():
    batch, given = OdometryBatch(odometries(), workers=1), [list(sequence) for sequence in sequences()]
    batch.step([frames[1] for frames in given])
    with pytest.raises(InputError, match="t_ns: expected more than"):
        batch.step([given[0][0], given[1][2], given[2][2]])
    assert [len(result.frames) for result in batch.finish()] == [1, 2, 2]


def test_wrong_numbers_are_refused():
    batch = OdometryBatch(odometries())
    for call in (batch.step, batch.run):
        with pytest.raises(InputError, match="expected 3, got 1"):
            call([None])  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="workers: expected at least 1, got 0"):
        OdometryBatch(odometries(), workers=0)
    with pytest.raises(InputError, match="odometries: expected some"):
        OdometryBatch([])
