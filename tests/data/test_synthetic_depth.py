"""A synthetic depth sensor: noise of the size that is asked for, holes of the share, and the same image beside it."""

import numpy as np
import pytest

from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence

SETTINGS = {"camera": "pinhole", "width": 160, "height": 120, "frames": 2, "world": "courtyard", "seed": 4}


def test_depth_has_its_noise_and_its_holes_and_knows_nothing_of_the_sky():
    sequence = SyntheticSequence(SyntheticConfig(**SETTINGS, depth_noise=0.02, depth_holes=0.3))
    true, depth = sequence.range(0).numpy(), sequence.frame(0).depth
    assert depth is not None
    assert depth.dtype == np.float32
    known = depth > 0
    assert np.isinf(true).any()
    assert not known[np.isinf(true)].any()
    finite = np.isfinite(true)
    assert 0.6 < known[finite].mean() < 0.8
    assert abs(np.std(depth[known] / true[known] - 1) - 0.02) < 0.002


def test_the_sensor_changes_nothing_of_the_image_and_equal_seeds_give_equal_bits():
    plain = SyntheticSequence(SyntheticConfig(**SETTINGS, noise=0.05))
    sensing = SyntheticSequence(SyntheticConfig(**SETTINGS, noise=0.05, depth_noise=0.01))
    assert plain.frame(1).depth is None
    first, again = sensing.frame(1), sensing.frame(1)
    other, before = plain.frame(1), sensing.frame(0)
    assert first.image is not None
    assert other.image is not None
    assert first.depth is not None
    assert again.depth is not None
    assert before.depth is not None
    assert np.array_equal(first.image, other.image)
    assert np.array_equal(first.depth, again.depth)
    assert not np.array_equal(first.depth, before.depth)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [({"depth_noise": -0.1}, "depth_noise: expected None or"), ({"depth_holes": 1.5}, "depth_holes: expected a share")],
)
def test_impossible_sensors_are_refused_by_name(settings, complaint):
    with pytest.raises(InputError, match=complaint):
        SyntheticConfig(**settings)
