"""Loop verification: what it finds, how exactly, and what it refuses."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Pinhole
from torchvo360.checks import InputError
from torchvo360.loop import LoopEvidence, LoopFrame, LoopReason, VerifyConfig, make_loop_frame, verify_loop
from torchvo360.loop.verify import judge_evidence


def errors(S, true, unit: float) -> tuple[float, float, float]:
    """Rotation in degrees, translation in metres, and the logarithm of the scale."""
    s, s_true = (torch.linalg.det(M[:3, :3]) ** (1 / 3) for M in (S, true))
    angle = lie.so3_angle((S[:3, :3] / s) @ (true[:3, :3] / s_true).mT).rad2deg()
    return float(angle), float((S[:3, 3] - true[:3, 3]).norm() / unit), float((s / s_true).log())


def similarity_between(a: LoopFrame, b: LoopFrame, scale_a: float, scale_b: float) -> Tensor:
    """S_b_a of keyframes whose poses are exact, in metres, and whose units are 1 / scale metres."""
    S = lie.se3_inverse(b.T_world_cam) @ a.T_world_cam
    S[:3, :3] *= scale_b / scale_a
    S[:3, 3] *= scale_b
    return S


CASES = [
    # world, displacement, yaw, scale of B, gain of B
    ("room", (0.0, 0.0, 0.0), math.pi, 0.5, 1.0),
    ("room", (0.2, -0.1, 0.03), 2.5, 1.7, 0.6),
    ("courtyard", (-0.2, 0.2, 0.0), -1.0, 2.0, 1.5),
    ("pillars", (0.1, 0.3, -0.05), 0.5, 0.8, 0.7),
]


@pytest.mark.parametrize(("world", "offset", "yaw", "scale", "gain"), CASES)
def test_a_place_seen_again_is_found_with_its_scale(world, offset, yaw, scale, gain, request):
    studio = request.getfixturevalue(world)
    a = studio.frame(studio.pose(), seed=1)
    b = studio.frame(studio.pose(offset, yaw, (0.05, -0.04)), scale=scale, gain=gain, seed=2)
    result = verify_loop(a, b)
    assert result.accepted, result
    true = similarity_between(a, b, 1.0, scale)
    rotation, translation, log_scale = errors(result.S_b_a, true, scale)
    assert rotation < 0.1
    assert translation < 0.005
    assert abs(log_scale) < 0.015
    xi = lie.sim3_log(true @ lie.sim3_inverse(result.S_b_a))
    assert float(xi @ result.information @ xi) < 60, "seven degrees of freedom, honestly"


def test_swapping_the_keyframes_inverts_the_similarity(room):
    a, b = room.frame(room.pose(), seed=1), room.frame(room.pose((0.15, 0.1, 0.0), 1.0), scale=1.5, seed=2)
    there, back = verify_loop(a, b), verify_loop(b, a)
    assert there.accepted
    assert back.accepted
    product = lie.sim3_log(there.S_b_a @ back.S_b_a)
    assert float(product.abs().max()) < 5e-3
    assert there.inliers == pytest.approx(back.inliers, abs=0.05)


def test_the_same_frames_give_the_same_bits(room):
    a, b = room.frame(room.pose(), seed=1), room.frame(room.pose((0.15, 0.1, 0.0), 1.0), seed=2)
    first, second = verify_loop(a, b), verify_loop(a, b)
    assert torch.equal(first.S_b_a, second.S_b_a)
    assert torch.equal(first.information, second.information)


def test_gain_of_four_is_bridged(courtyard):
    a = courtyard.frame(courtyard.pose(), gain=0.25, seed=1)
    b = courtyard.frame(courtyard.pose((0.1, 0.1, 0.0), 2.0), seed=2)
    assert verify_loop(a, b).accepted


def test_other_places_are_refused(room, courtyard, pillars):
    frames = [
        studio.frame(studio.pose(at=at, yaw=yaw), seed=3)
        for studio, at, yaw in ((room, 0.0, 0.0), (room, math.pi, 1.0), (courtyard, 0.0, 0.0), (pillars, 0.0, 2.0))
    ]
    for k, a in enumerate(frames):
        for b in frames[:k]:
            result = verify_loop(a, b)
            assert not result.accepted
            assert result.reason in (LoopReason.IMAGES_DISAGREE, LoopReason.NO_ROTATION)
            assert bool(result.S_b_a.isfinite().all())
            assert bool(result.information.isfinite().all())


def test_images_that_agree_with_ranges_that_do_not_are_refused(room):
    a, b = room.frame(room.pose(), seed=1), room.frame(room.pose(yaw=1.0), seed=2)
    shuffled = b.rho[torch.randperm(len(b.rho), generator=torch.Generator().manual_seed(0))]
    noise = torch.exp(torch.randn(len(b.rho), generator=torch.Generator().manual_seed(1)))
    rho = shuffled * noise
    result = verify_loop(a, replace(b, rho=rho, variance=(0.05 * rho) ** 2))
    assert not result.accepted


def test_black_images_and_few_points_are_refused_with_finite_numbers(room):
    a = room.frame(room.pose(), seed=1)
    black = replace(a, images=tuple(torch.zeros_like(image) for image in a.images))
    for first, second in ((a, black), (black, a), (black, black)):
        result = verify_loop(first, second)
        assert result.reason is LoopReason.NO_ROTATION
        assert bool((result.information == 0).all())
    few = replace(a, ray=a.ray[:, :100], rho=a.rho[:100], variance=a.variance[:100])
    assert verify_loop(a, few).reason is LoopReason.TOO_FEW_POINTS
    none = replace(a, ray=a.ray[:, :0], rho=a.rho[:0], variance=a.variance[:0])
    assert verify_loop(none, a).reason is LoopReason.TOO_FEW_POINTS


def test_a_masked_camera_is_verified_by_what_it_sees(room):
    mask = torch.ones(256, 512, dtype=torch.bool)
    mask[200:] = False
    a = room.frame(room.pose(), seed=1, mask=mask)
    b = room.frame(room.pose((0.1, 0.1, 0.0), 2.0), seed=2, mask=mask)
    assert verify_loop(a, b).accepted


def test_a_pinhole_is_verified_in_about_the_same_view(room):
    camera = Pinhole(320, 240, 160.0, 160.0, 160.0, 120.0)
    a = room.frame(room.pose(), seed=1, camera=camera, points=1500)
    b = room.frame(room.pose((0.1, 0.05, 0.0), 0.1), scale=1.4, seed=2, camera=camera, points=1500)
    away = room.frame(room.pose(yaw=2.5), seed=2, camera=camera, points=1500)
    result = verify_loop(a, b)
    assert result.accepted, result
    rotation, translation, log_scale = errors(result.S_b_a, similarity_between(a, b, 1.0, 1.4), 1.4)
    assert rotation < 0.3
    assert translation < 0.02
    assert abs(log_scale) < 0.03
    assert not verify_loop(a, away).accepted


def test_every_test_can_refuse():
    config = VerifyConfig()
    good = LoopEvidence(agreement=0.8, range_agreement=0.8, baseline=0.2, turn_deg=0.01, shift=0.001)
    assert judge_evidence(good, config) is LoopReason.ACCEPTED
    for change, reason in (
        ({"agreement": 0.1}, LoopReason.IMAGES_DISAGREE),
        ({"agreement": math.nan}, LoopReason.IMAGES_DISAGREE),
        ({"range_agreement": 0.2}, LoopReason.RANGES_DISAGREE),
        ({"baseline": 2.0}, LoopReason.TOO_FAR),
        ({"turn_deg": 2.0}, LoopReason.DIRECTIONS_DISAGREE),
        ({"shift": math.inf}, LoopReason.DIRECTIONS_DISAGREE),
    ):
        assert judge_evidence(good._replace(**change), config) is reason


# What is kept


def test_a_keyframe_costs_less_than_200_kb_and_keeps_its_levels_to_a_step_of_8_bits(room):
    frame = room.frame(room.pose())
    assert frame.bytes < 200_000
    assert [camera.width for camera in frame.cameras] == [256, 128, 64]
    target = frame.target(0)
    assert target.padded.shape == (1, 1, 130, 258)
    assert float(target.padded.max()) <= 1.0


def test_points_that_are_nowhere_are_left_out(room):
    frame = room.frame(room.pose())
    targets = [frame.target(level) for level in range(3)]
    rho = frame.rho.clone()
    rho[:4] = torch.tensor([torch.nan, torch.inf, 0.0, -1.0])
    kept = make_loop_frame(frame.T_world_cam, targets, frame.ray * 3, rho, frame.variance)
    torch.testing.assert_close(kept.rho, frame.rho[4:])
    torch.testing.assert_close(kept.ray, frame.ray[:, 4:])


def test_bad_input_is_refused_with_its_name(room):
    frame = room.frame(room.pose())
    targets = [frame.target(level) for level in range(3)]
    with pytest.raises(InputError, match="rho"):
        make_loop_frame(frame.T_world_cam, targets, frame.ray, frame.rho[:5], frame.variance)
    with pytest.raises(InputError, match="targets"):
        make_loop_frame(frame.T_world_cam, [], frame.ray, frame.rho, frame.variance)
    with pytest.raises(InputError, match="T_world_cam"):
        make_loop_frame(2 * frame.T_world_cam, targets, frame.ray, frame.rho, frame.variance)
    with pytest.raises(InputError, match="a, b"):
        verify_loop(frame, replace(frame, cameras=frame.cameras[:2], images=frame.images[:2], known=frame.known[:2]))
    with pytest.raises(InputError, match="min_agreement"):
        VerifyConfig(min_agreement=2.0)
    with pytest.raises(InputError, match="points_by_level"):
        VerifyConfig(points_by_level=[])


def test_a_camera_laid_on_its_side_is_verified_over_both_poles(room):
    a = room.frame(room.pose(), seed=1)
    b = room.frame(room.pose((0.1, 0.1, 0.0), 1.0, (math.pi / 2, 0.7)), scale=1.3, seed=2)
    result = verify_loop(a, b)
    assert result.accepted
    assert errors(result.S_b_a, similarity_between(a, b, 1.0, 1.3), 1.3)[0] < 0.1
