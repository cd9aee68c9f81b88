"""Immature points: their guesses come to the true ranges, those that cannot be told stay guesses, and say so."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.depth import InverseRange
from torchvo360.vo import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.candidates import RIPE_SCORE, Candidates
from torchvo360.vo.keyframes.keyframe import make_keyframe

CAMERA = Equirectangular(256, 128)
CONFIG = OdometryConfig(blur_px=0.5)
EYE = torch.eye(4, dtype=torch.float64)
NO_CHANGE = torch.zeros(2, dtype=torch.float64)
LIMIT = CONFIG.map.max_relative_variance


class Scene:
    """A keyframe and later frames whose poses are known."""

    def __init__(self, motion: str = "walk") -> None:
        settings = SyntheticConfig(width=256, height=128, frames=12, seed=1, motion=motion)
        self.sequence = SyntheticSequence(settings)
        self.builder = FrameBuilder(CAMERA, 3, CONFIG.blur_px, None, CONFIG.saturation)
        self.frames = [self.frame(index) for index in range(12)]

    def frame(self, index: int, gain: float = 1.0) -> PyramidFrame:
        image = self.sequence.frame(index).image
        assert image is not None
        return self.builder.build((image * gain).astype("uint8"), index, index)

    def T(self, index: int) -> Tensor:
        """T_cam_key."""
        return lie.se3_inverse(self.sequence.pose(index)) @ self.sequence.pose(0)

    def candidates(self, *, wrong: float = 1.4) -> Candidates:
        """All points with inverse ranges that are too large or too small by a factor, and known to 60 %."""
        key = make_keyframe(self.frames[0], EYE, self.builder, CONFIG.map)
        factor = torch.where(torch.arange(len(key.pixel)) % 2 == 0, wrong, 1 / wrong)
        rho = factor / self.sequence.range(0).flatten()[key.pixel]
        points = InverseRange(rho, (0.6 * rho).square(), torch.zeros_like(rho))
        return Candidates(key.frame, key.pixel, key.ray, key.slope, points)

    def error(self, candidates: Candidates, index: Tensor) -> Tensor:
        true = self.sequence.range(0).flatten()[candidates.pixel[index]]
        return (candidates.points.rho[index] * true - 1).abs()

    def observed(self, candidates: Candidates, *indices: int, gain: float = 1.0) -> Candidates:
        affine = torch.tensor([gain, 1.0], dtype=torch.float64).log()
        for index in indices:
            frame = self.frames[index] if gain == 1 else self.frame(index, gain)
            candidates.observe(frame, self.T(index), affine, CONFIG.epipolar, CONFIG.filter)
        return candidates


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_nothing_is_ripe_before_it_has_been_seen_twice(scene):
    candidates = scene.candidates()
    assert len(candidates.ripe(LIMIT)) == 0
    assert len(scene.observed(candidates, 3).ripe(LIMIT)) == 0
    assert RIPE_SCORE == 2
    assert len(scene.observed(candidates, 6).ripe(LIMIT)) > 100


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_guesses_come_to_the_true_ranges_also_in_another_light(scene, gain):
    candidates = scene.observed(scene.candidates(), 3, 6, 9, 11, gain=gain)
    ripe = candidates.ripe(LIMIT)
    assert len(ripe) > 0.4 * len(candidates.pixel)
    error = scene.error(candidates, ripe)
    assert float(error.median()) < 0.04
    assert float(error.quantile(0.9)) < 0.2
    rho, variance, score = (part[ripe] for part in candidates.points)
    assert bool((variance < LIMIT * rho * rho).all())
    assert bool((score >= RIPE_SCORE).all())


def test_those_across_the_seam_and_near_the_poles_ripen_too(scene):
    candidates = scene.observed(scene.candidates(), 3, 6, 9, 11)
    column = candidates.pixel % 256
    is_ripe = torch.zeros(len(column), dtype=torch.bool)
    is_ripe[candidates.ripe(LIMIT)] = True
    usual = float(is_ripe.double().mean())
    for place in ((column < 6) | (column >= 250), candidates.ray[1].abs() > 0.9):
        assert int(place.sum()) > 100
        assert float(is_ripe[place].double().mean()) > 0.5 * usual
        assert float(scene.error(candidates, (is_ripe & place).nonzero()[:, 0]).median()) < 0.06


def test_a_camera_that_does_not_move_tells_no_range(scene):
    candidates = scene.candidates()
    before = candidates.points
    for _ in range(4):
        candidates.observe(scene.frames[0], EYE, NO_CHANGE, CONFIG.epipolar, CONFIG.filter)
    assert len(candidates.ripe(LIMIT)) == 0
    assert bool((candidates.points.variance >= 0.9 * before.variance).all())
    assert all(bool(part.isfinite().all()) for part in candidates.points)


def test_frames_of_another_place_hardly_make_any_ripe(scene):
    """3 % by chance, where frames of the same place ripen more than 40 %."""
    other = SyntheticSequence(SyntheticConfig(world="courtyard", width=256, height=128, frames=4, seed=9))
    candidates = scene.candidates()
    for index in range(4):
        image = other.frame(index).image
        assert image is not None
        candidates.observe(
            scene.builder.build(image, index, index), scene.T(3 + index), NO_CHANGE, CONFIG.epipolar, CONFIG.filter
        )
    assert len(candidates.ripe(LIMIT)) < 0.05 * len(candidates.pixel)


def test_none_are_observed_and_none_are_ripe(scene):
    key = scene.candidates()
    empty = torch.zeros(0)
    none = replace(key, pixel=key.pixel[:0], ray=key.ray[:, :0], slope=empty, points=InverseRange(empty, empty, empty))
    assert len(scene.observed(none, 3).ripe(LIMIT)) == 0
