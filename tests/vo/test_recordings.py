"""The recordings that bad days are made of (benchmarks/bad_days.py): orders, times, images and poses go together."""

import math

import cv2
import numpy as np
import pytest
import torch

import bad_days
from bad_days import STEP_NS, Recording, rendered
from torchvo360.data.images import open_images
from torchvo360.data.masks import parse_mask
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence


@pytest.fixture(scope="module")
def recording() -> Recording:
    return rendered(world="room", frames=12, width=128, height=64).held()


@pytest.fixture(scope="module")
def numbered(tmp_path_factory) -> Recording:
    """Files of which each says its number by its grey."""
    folder = tmp_path_factory.mktemp("numbered")
    for k in range(120):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((16, 32, 3), 20 + k, np.uint8))
    images = open_images(str(folder))
    return Recording.of_images(images, 120, {k: k * torch.eye(4, dtype=torch.float64) for k in range(120)})


def greys(recording: Recording) -> list[int]:
    return [int(frame.image[0, 0, 0]) - 20 for frame in recording if frame.image is not None]


@pytest.mark.parametrize(
    "order",
    [range(120), range(119, -1, -1), [*range(110), *range(10, 40)], [3, 3, 3, 5, 5, 9, 9, 2], [7]],
    ids=["forwards", "backwards", "jump", "repeats", "one"],
)
def test_files_are_read_in_any_order(numbered, order):
    day = numbered.in_order(order)
    assert greys(day) == list(order)
    assert [frame.index for frame in day] == list(range(len(order)))
    assert [frame.t_ns for frame in day] == [k * STEP_NS for k in range(len(order))]
    assert [float(day.T_world_cam[k][0, 0]) for k in range(len(day))] == list(order)


def test_faults_of_order_are_what_their_names_say(numbered):
    lost = bad_days.dropped_frames(numbered, range(50, 60))
    kept = [*range(50), *range(60, 120)]
    assert greys(lost) == [frame.index for frame in lost] == kept
    assert [frame.t_ns for frame in lost] == [k * STEP_NS for k in kept]
    doubled = bad_days.doubled_frames(numbered, [4, 9])
    assert greys(doubled)[3:12] == [3, 4, 4, 6, 7, 8, 9, 9, 11]
    back = bad_days.jump_back(numbered, at=110)
    assert greys(back)[108:] == [108, 109, *range(10, 20)]
    assert greys(bad_days.dropped_frames(back.in_order(range(115)), [0, 111]))[-4:] == [10, 12, 13, 14]


def test_frames_keep_poses_that_are_known_and_times_that_fit(recording):
    partly = Recording(
        recording.name,
        recording.camera,
        recording.read,
        len(recording),
        {k: T for k, T in recording.T_world_cam.items() if k != 3},
        recording.index,
    )
    truth = bad_days.dropped_frames(partly, [5]).truth
    known = [0, 1, 2, 4, 6, 7, 8, 9, 10, 11]
    assert truth.t_ns.tolist() == [k * STEP_NS for k in known]
    assert torch.equal(truth.T_world_cam, torch.stack([recording.T_world_cam[k] for k in known]))


def test_black_frames_are_judged_as_those_of_a_file(recording):
    problems = [frame.problem for frame in bad_days.black_frames(recording, at=4, count=3)]
    assert problems == [""] * 4 + ["black"] * 3 + [""] * 5


def test_turning_moves_images_and_poses_alike(recording):
    """The turned camera, rendered anew at the turned pose, sees what the rolled image shows."""
    day = bad_days.yaw_jump(recording, at=6, jump_deg=45.0)
    sequence = SyntheticSequence(SyntheticConfig(world="room", frames=12, width=128, height=64))
    frames = list(day)
    for k in (5, 8):
        image, _ = sequence.world.render(day.camera, day.T_world_cam[k], t=k / 30)
        shown = torch.from_numpy(frames[k].image).permute(2, 0, 1) / 255
        assert float((image - shown).abs().median()) < 0.01


def test_the_exposure_jumps_between_half_and_twice_and_clips(recording):
    day = list(bad_days.exposure_jumps(recording, every=3))
    for k, gain in ((0, 0.5), (2, 0.5), (3, 2.0), (5, 2.0), (6, 0.5)):
        plain = next(recording.read([k])).image.astype(np.float64)
        assert np.abs(day[k].image - (gain * plain).clip(0, 255)).max() <= 0.51


@pytest.mark.parametrize("sectors", [None, "below:-18"])
def test_a_patch_and_a_sky_cover_their_share_of_what_may_be_used(recording, sectors):
    mask = None if sectors is None else parse_mask(sectors, recording.camera)
    area = recording.camera.solid_angle(recording.camera.pixel_grid())
    area = area if mask is None else area * mask
    plain = list(recording)
    for day, share, spread in (
        (bad_days.covered(recording, 1 / 3, mask), 1 / 3, 0.07),
        (bad_days.half_sky(recording, mask), 0.5, 0.06),
    ):
        shares = []
        for before, after in zip(plain, day, strict=True):
            changed = torch.from_numpy((before.image != after.image).any(-1))
            shares.append(float(area[changed].sum() / area.sum()))
        assert all(math.isclose(found, share, abs_tol=spread) for found in shares)
