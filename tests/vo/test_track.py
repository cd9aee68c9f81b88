"""Tracking: from wrong predictions, under other exposures, with noisy inverse ranges, and when it must fail."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.depth import InverseRange
from torchvo360.vo import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, make_keyframe
from torchvo360.vo.track import Track, TrackConfig, track

CAMERA = Equirectangular(256, 128)
EYE = torch.eye(4, dtype=torch.float64)
NO_CHANGE = torch.zeros(2, dtype=torch.float64)
LIMIT = 0.05


class Scene:
    """A keyframe with true inverse ranges, and a frame some way off."""

    def __init__(self, gap: int = 5) -> None:
        self.sequence = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=gap + 1, seed=2))
        self.builder = FrameBuilder(CAMERA, 3, 0.5, None, 252 / 255)
        images = [self.sequence.frame(index).image for index in (0, gap)]
        self.images = [image for image in images if image is not None]
        self.T_cam_key = lie.se3_inverse(self.sequence.pose(gap)) @ self.sequence.pose(0)
        frame = self.builder.build(self.images[0], 0, 0)
        self.base = make_keyframe(frame, EYE, self.builder, OdometryConfig().map)
        self.rho = 1 / self.sequence.range(0).flatten()[self.base.pixel]

    def key(self, *, relative_sigma: float = 0.0, claimed: float = 0.01, seed: int = 0) -> Keyframe:
        noise = torch.randn(self.rho.shape, generator=torch.Generator().manual_seed(seed))
        rho = (self.rho * (1 + relative_sigma * noise)).clamp_min(1e-3)
        points = InverseRange(rho, (claimed * self.rho) ** 2, torch.ones_like(rho))
        return replace(self.base, points=points)

    def frame(self, gain: float = 1.0, offset: float = 0.0) -> PyramidFrame:
        image = np.clip(self.images[1] * gain + 255 * offset, 0, 255).astype(np.uint8)
        return self.builder.build(image, 1, 1)

    def track(self, start: Tensor, *, frame: PyramidFrame | None = None, key: Keyframe | None = None) -> Track:
        start = start[None] if start.ndim == 2 else start
        frame, key = self.frame() if frame is None else frame, self.key() if key is None else key
        found = track(key, frame, start, NO_CHANGE, TrackConfig(), LIMIT)
        assert found is not None
        return found

    def errors(self, found: Track) -> tuple[float, float]:
        """Degrees, and metres."""
        E = found.T_cam_key @ lie.se3_inverse(self.T_cam_key)
        return float(lie.so3_angle(E[:3, :3]).rad2deg()), float(E[:3, 3].norm())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def off(angle_deg: float, metres: float, seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    w, v = torch.randn(2, 3, generator=g, dtype=torch.float64)
    return lie.se3(lie.so3_exp(w / w.norm() * math.radians(angle_deg)), v / v.norm() * metres)


@pytest.mark.parametrize("seed", range(6))
def test_a_pose_is_found_from_5_degrees_and_20_centimetres_off(scene, seed):
    found = scene.track(off(5.0, 0.2, seed) @ scene.T_cam_key)
    rotation, distance = scene.errors(found)
    assert rotation < 0.1
    assert distance < 0.004
    assert found.inliers > 0.85
    assert found.residual < 0.02


def test_the_best_of_several_hypotheses_is_followed(scene):
    wrong = [off(120.0, 0.5, seed) for seed in range(3)]
    found = scene.track(torch.stack([*wrong, off(3.0, 0.1, 9) @ scene.T_cam_key]))
    assert scene.errors(found)[1] < 0.004


def test_the_keyframe_s_own_image_is_at_identity(scene):
    found = track(scene.key(), scene.base.frame, off(1.0, 0.02, 0)[None], NO_CHANGE, TrackConfig(), LIMIT)
    assert found is not None
    assert float((found.T_cam_key - EYE).abs().max()) < 1e-3
    assert found.residual < 1e-3
    assert found.inliers > 0.999


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.1), (0.25, 0.0), (1.3, -0.1)])
def test_a_change_of_brightness_is_found_along(scene, gain, offset):
    found = scene.track(scene.T_cam_key @ off(1.0, 0.02, 1), frame=scene.frame(gain, offset))
    rotation, distance = scene.errors(found)
    assert rotation < 0.2
    assert distance < 0.008
    assert float(found.affine[0]) == pytest.approx(math.log(gain), abs=0.05)
    assert float(found.affine[1]) == pytest.approx(offset, abs=0.02)


def test_the_result_is_a_pose(scene):
    T = scene.track(off(3.0, 0.1, 4) @ scene.T_cam_key).T_cam_key
    torch.testing.assert_close(T[:3, :3] @ T[:3, :3].mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert T[3].tolist() == [0, 0, 0, 1]


def test_a_pure_rotation_needs_no_ranges(scene):
    """All points at infinity: the translation says nothing, the rotation everything."""
    turned = lie.se3(lie.so3_exp(torch.tensor([0.02, 0.1, -0.03]).double()), torch.zeros(3).double())
    pose = scene.sequence.pose(0) @ lie.se3_inverse(turned)
    image = scene.sequence.world.render(CAMERA, pose)[0].clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).numpy()
    key = scene.key()
    found = track(key, scene.builder.build(image, 1, 1), EYE[None], NO_CHANGE, TrackConfig(), LIMIT)
    assert found is not None
    assert float(lie.so3_angle(found.T_cam_key[:3, :3] @ turned[:3, :3].mT).rad2deg()) < 0.05
    assert float(found.T_cam_key[:3, 3].norm()) < 0.003


def test_noise_in_rho_with_its_honest_variance_does_not_shrink_the_translation(scene):
    """Noise in rho that the weights do not know of shrinks every translation; with its variance that is taken back."""
    true, frame = float(scene.T_cam_key[:3, 3].norm()), scene.frame()

    def bias(claimed: float) -> float:
        lengths = []
        for seed in range(6):
            key = scene.key(relative_sigma=0.2, claimed=claimed, seed=seed)
            # no limit on the variance: by V / rho^2 it would choose the points whose rho came out too large
            found = track(key, frame, scene.T_cam_key[None], NO_CHANGE, TrackConfig(), math.inf)
            assert found is not None
            lengths.append(float(found.T_cam_key[:3, 3].norm()))
        return sum(lengths) / len(lengths) / true - 1

    overconfident, honest = bias(0.001), bias(0.2)
    assert overconfident < -0.015, "standard error 0.0015"
    assert abs(honest) < 0.013, "standard error 0.002"


def test_false_ranges_of_a_third_of_the_points_hardly_matter(scene):
    key = scene.key()
    wrong = torch.arange(len(scene.rho)) % 3 == 0
    key.points = key.points._replace(rho=torch.where(wrong, 3 * key.points.rho + 0.5, key.points.rho))
    rotation, distance = scene.errors(scene.track(off(1.0, 0.03, 3) @ scene.T_cam_key, key=key))
    assert rotation < 0.3
    assert distance < 0.02


@pytest.mark.parametrize("kind", ["noise", "black", "grey", "inverted"])
def test_an_unrelated_image_does_not_agree(scene, kind):
    """Also strong contrast, where a gain of zero explains most of the gradient within half a pixel."""
    rng = np.random.default_rng(0)
    image = {
        "noise": rng.integers(0, 255, (128, 256, 3), np.uint8),
        "black": np.zeros((128, 256, 3), np.uint8),
        "grey": np.full((128, 256, 3), 128, np.uint8),
        "inverted": np.ascontiguousarray(255 - scene.images[1][::-1]),
    }[kind]
    found = track(scene.key(), scene.builder.build(image, 1, 1), EYE[None], NO_CHANGE, TrackConfig(), LIMIT)
    assert found is None or found.inliers < 0.3
    assert found is None or bool(found.T_cam_key.isfinite().all())


def test_too_few_trusted_points_are_not_tracked(scene):
    key = scene.key()
    score = torch.zeros_like(key.points.score)
    score[:50] = 1
    key.points = key.points._replace(score=score)
    assert track(key, scene.frame(), EYE[None], NO_CHANGE, TrackConfig(), LIMIT) is None
    uncertain = scene.key(claimed=1.0)
    assert track(uncertain, scene.frame(), EYE[None], NO_CHANGE, TrackConfig(), LIMIT) is None


def test_points_of_masked_places_in_the_frame_do_not_count(scene):
    mask = torch.ones(128, 256, dtype=torch.bool)
    mask[:, 60:140] = False
    builder = FrameBuilder(CAMERA, 3, 0.5, mask, 252 / 255)
    spoiled = scene.images[1].copy()
    spoiled[:, 62:138] = np.random.default_rng(0).integers(0, 255, (128, 76, 3), np.uint8)
    found = scene.track(off(1.0, 0.03, 3) @ scene.T_cam_key, frame=builder.build(spoiled, 1, 1))
    assert scene.errors(found)[1] < 0.006
    assert found.inliers > 0.8


@pytest.mark.parametrize("value", [[], [0, 3]])
def test_unusable_settings_are_refused_by_name(value):
    with pytest.raises(InputError, match="points_by_level"):
        TrackConfig(points_by_level=value)
    with pytest.raises(InputError, match="steps_by_level"):
        TrackConfig(steps_by_level=value)
