"""Relative motions: their pairs and errors against plain loops, and drift against KITTI's definition."""

import math

import pytest
import torch

from torchvo360.evaluation.relative import drift, motion_errors, pairs_by_distance, pairs_by_frames, travelled
from torchvo360.lie import se3_exp, so3_angle


def path(frames: int, seed: int, noise: float = 0.0) -> torch.Tensor:
    """Poses along a winding path that stands still now and then; with noise, the same with errors that add up."""
    generator = torch.Generator().manual_seed(seed)
    steps = 0.1 * torch.randn(frames, 6, generator=generator, dtype=torch.float64)
    steps[:, 2] += 0.2
    steps[torch.rand(frames, generator=generator) < 0.2] = 0
    steps += noise * torch.randn(frames, 6, generator=generator, dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3_exp(step))
    return torch.stack(poses)


@pytest.mark.parametrize("frames", [1, 7, 59, 500])
def test_pairs_by_frames_are_all_with_that_many_between_or_the_whole(frames):
    i, j = pairs_by_frames(60, frames)
    assert (j - i).unique().tolist() == [min(frames, 59)]
    assert i.tolist() == list(range(60 - min(frames, 59)))


@pytest.mark.parametrize("metres", [0.25, 0.5, 3.0, 1000.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_by_distance_are_those_of_an_exhaustive_search(metres, seed):
    path_m = travelled(path(80, seed)[:, :3, 3])
    expected = []
    for i in range(79):
        off = (path_m[i + 1 :] - path_m[i] - metres).abs()
        j = i + 1 + int(off.argmin())
        if off.min() <= 0.1 * metres and path_m[j] > path_m[i]:
            expected.append((i, j))
    i, j = pairs_by_distance(path_m, metres)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected
    assert bool(expected) == (metres < 1000)


def test_a_path_without_length_has_no_pairs_and_no_drift():
    still = torch.eye(4, dtype=torch.float64).repeat(9, 1, 1)
    assert [len(index) for index in pairs_by_distance(travelled(still[:, :3, 3]), 0.0)] == [0, 0]
    none = drift(still, still, 1.0, [1.0])
    assert len(none.length_m) == 0
    assert none.mean_translation_percent is None
    assert none.mean_rotation_deg_per_m is None


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_drift_is_that_of_kittis_loops(scale):
    truth, estimate = path(120, 3), path(120, 3, noise=0.01)
    estimate[:, :3, 3] /= scale
    lengths = [1.0, 2.5, 5.0, 1e4]
    result = drift(estimate, truth, scale, lengths)
    path_m = travelled(truth[:, :3, 3]).tolist()
    translation, rotation, count = [], [], []
    scaled = estimate.clone()
    scaled[:, :3, 3] *= scale
    for length in lengths[:-1]:
        errors = []
        for first in range(120):
            last = next((j for j in range(first, 120) if path_m[j] > path_m[first] + length), None)
            if last is not None:
                true = torch.linalg.inv(truth[first]) @ truth[last]
                E = torch.linalg.inv(torch.linalg.inv(scaled[first]) @ scaled[last]) @ true
                errors.append((float(E[:3, 3].norm()) / length, float(so3_angle(E[:3, :3])) / length))
        translation.append(100 * sum(t for t, _ in errors) / len(errors))
        rotation.append(math.degrees(sum(r for _, r in errors) / len(errors)))
        count.append(len(errors))
    assert result.length_m.tolist() == lengths[:-1]
    assert result.count.tolist() == count
    torch.testing.assert_close(result.translation_percent, torch.tensor(translation, dtype=torch.float64))
    torch.testing.assert_close(result.rotation_deg_per_m, torch.tensor(rotation, dtype=torch.float64))
    mean = sum(t * n for t, n in zip(translation, count, strict=True)) / sum(count)
    assert result.mean_translation_percent == pytest.approx(mean)


def test_a_motion_with_a_known_error_has_that_error():
    truth = path(30, 5)
    error = se3_exp(torch.tensor([0.03, 0.0, 0.04, 0.0, math.radians(2), 0.0], dtype=torch.float64))
    estimate = truth.clone()
    estimate[20:] = truth[20:] @ error
    error_m, error_deg, _ = motion_errors(estimate, truth, 1.0, (torch.tensor([3, 12]), torch.tensor([12, 25])))
    torch.testing.assert_close(error_m, torch.tensor([0.0, float(error[:3, 3].norm())], dtype=torch.float64))
    torch.testing.assert_close(error_deg, torch.tensor([0.0, 2.0], dtype=torch.float64), atol=1e-6, rtol=0)
