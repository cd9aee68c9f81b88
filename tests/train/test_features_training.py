"""Learning features by the error of the pose: the pairs are sound, a few steps help, basins are told as they are."""

import csv
import json
import math
from dataclasses import replace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from basin import has_converged, intensity, learned
from basin_report import FEATURES, OTHER, ROTATION, SAME, Row, at, compare, reach, report_basin
from command import main
from features import FeatureExperiment, FeaturesConfig, drawn_back, pose_error, run
from illumination import IlluminationConfig, relit
from pairs import PairsConfig, displaced, median_range, mirrored, render_pairs, turned
from torchvo360 import AlignConfig
from torchvo360.checks import InputError
from torchvo360.learn import load_checkpoint
from torchvo360.learn.checkpoint import SHIPPED_FEATURES
from torchvo360.learn.range_losses import warped
from torchvo360.lie import so3_angle

SMALL = {
    "_target_": "torchvo360.learn.features.PanoramaFeatures",
    "widths": [8, 8, 12, 16],
    "channels": [2, 2, 4, 4],
}


@pytest.fixture(scope="module")
def pairs():
    return render_pairs(PairsConfig(kinds=["room", "courtyard"], pairs=6, seed=2001))


@pytest.fixture(scope="module")
def experiment():
    config = FeaturesConfig(features=SMALL, pairs=PairsConfig(kinds=["room"], pairs=8), validation_pairs=4)
    config.trainer.batch_size = 4
    torch.manual_seed(0)
    return FeatureExperiment.make(config)


def _mismatch(pairs):
    seen = warped(pairs.tgt, pairs.rho, pairs.T_tgt_ref, pairs.camera)
    return (seen - pairs.ref).abs().mean((1, 2, 3))


def test_turned_and_mirrored_pairs_fit_their_motion_as_well_as_before(pairs):
    turns = turned(pairs, torch.Generator().manual_seed(0))
    assert bool((so3_angle(turns.T_tgt_ref[:, :3, :3] @ pairs.T_tgt_ref[:, :3, :3].mT) > 0.1).any())
    mirrors = mirrored(pairs, torch.arange(len(pairs)) % 2 == 0)
    assert torch.equal(mirrors.ref[1::2], pairs.ref[1::2])
    for changed in (turns, mirrors):
        torch.testing.assert_close(_mismatch(changed), _mismatch(pairs), atol=2e-3, rtol=0.02)
        wrong = replace(changed, T_tgt_ref=pairs.T_tgt_ref)
        assert float(_mismatch(wrong).mean()) > 1.3 * float(_mismatch(changed).mean())


def test_light_changes_images_and_can_be_left_as_it_is(pairs):
    generator = torch.Generator().manual_seed(0)
    strength = (torch.arange(len(pairs)) % 2).float()
    image = relit(pairs.tgt, IlluminationConfig(), generator, strength)
    assert float(image.min()) >= 0
    assert float(image.max()) <= 1
    torch.testing.assert_close(image[::2], pairs.tgt[::2], atol=2e-4, rtol=0)
    assert float((image - pairs.tgt)[1::2].abs().mean()) > 0.05


def test_a_change_of_light_that_is_none_is_refused():
    with pytest.raises(InputError, match="illumination: expected gain"):
        IlluminationConfig(gain=0.5)


def test_starts_are_wrong_by_what_was_asked_for(pairs):
    start = displaced(pairs.T_tgt_ref, math.radians(50), 0.7, torch.Generator().manual_seed(0))
    angle = so3_angle(start[:, :3, :3] @ pairs.T_tgt_ref[:, :3, :3].mT)
    distance = (start - pairs.T_tgt_ref)[:, :3, 3].norm(dim=-1)
    torch.testing.assert_close(angle, torch.full_like(angle, math.radians(50)))
    torch.testing.assert_close(distance, torch.full_like(distance, 0.7))
    converged, rotation, share = has_converged(start, pairs)
    assert not bool(converged.any())
    torch.testing.assert_close(rotation, angle.rad2deg())
    torch.testing.assert_close(share * median_range(pairs.rho), distance)
    back = drawn_back(start, pairs.T_tgt_ref, torch.full_like(angle, 0.1))
    torch.testing.assert_close(so3_angle(back[:, :3, :3] @ pairs.T_tgt_ref[:, :3, :3].mT), 0.1 * angle)


def test_half_of_the_sphere_lies_beyond_the_median_range():
    rho = torch.full((2, 8, 16), 0.5)
    rho[:, 4:] = 0.25  # equal halves; of three quarters the farther wins
    rho[1, :, :9] = 0.25
    torch.testing.assert_close(median_range(rho)[1], torch.tensor(4.0, dtype=torch.float64))
    assert float(median_range(torch.zeros(1, 8, 16))) == pytest.approx(100.0)


def test_a_batch_is_a_function_of_its_step_and_the_parts_make_it_up(experiment):
    whole, again, next_one = (experiment.batch(step, 0, 1) for step in (3, 3, 4))
    halves = [experiment.batch(3, part, 2) for part in range(2)]
    for name, value in whole.items():
        assert torch.equal(value, again[name])
        assert not torch.equal(value, next_one[name])
        assert torch.equal(value, torch.cat([half[name] for half in halves]))


def test_starts_become_worse_with_the_steps(experiment):
    def worst(step):
        batch = experiment.batch(step, 0, 1)
        return float(so3_angle(batch["start"][:, :3, :3] @ batch["T_tgt_ref"][:, :3, :3].mT).max())

    first, last = (max(worst(step) for step in range(begin, begin + 4)) for begin in (0, 1000))
    assert first < math.radians(45) < last


def test_the_pose_error_is_that_of_rotation_and_of_translation_seen_from_the_scene(pairs):
    start = displaced(pairs.T_tgt_ref, 0.1, 0.5, torch.Generator().manual_seed(0)).requires_grad_()
    scene = torch.full((len(pairs),), 2.0, dtype=torch.float64)
    error = pose_error(start, pairs.T_tgt_ref, scene)
    torch.testing.assert_close(error.detach(), torch.full_like(scene, 2 * math.sin(0.05) + 0.25), atol=1e-6, rtol=0)
    at_truth = pairs.T_tgt_ref.clone().requires_grad_()
    pose_error(at_truth, pairs.T_tgt_ref, scene).sum().backward()
    assert bool(torch.isfinite(at_truth.grad).all())


def test_a_few_steps_lower_the_loss(experiment):
    module = experiment.module
    batch = experiment.batch(0, 0, 1)
    optimizer = torch.optim.Adam(module.parameters(), 5e-3)
    values = []
    for _ in range(8):
        losses = experiment.losses(module, batch)
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()
        values.append(float(losses["loss"].detach()))
    assert min(values[-3:]) < 0.8 * values[0]
    figures = experiment.validate(module)
    assert all(math.isfinite(value) for value in figures.values())
    for name, picture in experiment.pictures(module).items():
        assert picture.ndim == 3, name
        assert 0 <= float(picture.min()) <= float(picture.max()) <= 1, name


def test_half_precision_is_for_the_network_alone(tmp_path):
    overrides = [
        f"out={tmp_path / 'run'}",
        *("trainer.steps=1", "trainer.batch_size=2", "pairs.pairs=2", "pairs.kinds=[room]", "validation_pairs=1"),
        *(f"+features.{key}={value}".replace(" ", "") for key, value in SMALL.items() if key != "_target_"),
        *("measure=false", "trainer.precision=bf16-mixed"),
    ]
    assert main("features", FeaturesConfig, run, overrides) == 0


def test_the_script_trains_and_measures(tmp_path, capsys):
    overrides = [
        f"out={tmp_path / 'run'}",
        *("trainer.steps=2", "trainer.batch_size=2", "pairs.pairs=4", "pairs.kinds=[room]", "validation_pairs=2"),
        *(f"+features.{key}={value}".replace(" ", "") for key, value in SMALL.items() if key != "_target_"),
        *("basin.pairs=2", "basin.kinds=[room]", "basin.rotations_deg=[10]", "basin.coarsest_widths=[16]"),
        *("basin.translations_m=[]", "basin.both_deg=[]"),
    ]
    assert main("features", FeaturesConfig, run, overrides) == 0
    assert "features at twice that" in capsys.readouterr().out
    folder = tmp_path / "run"
    assert {"basin.csv", "basin.md", "basin.png", "best.safetensors"} <= {path.name for path in folder.iterdir()}
    with (folder / "basin.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["light"] for row in rows} == {SAME, OTHER}
    assert all(0 <= float(row["converged"]) <= 1 for row in rows)
    assert load_checkpoint(folder / "best").down[0][0].out_channels == 8
    pictures: set[str] = set()
    for file in (folder / "tensorboard").iterdir():
        pictures |= set(EventAccumulator(str(file)).Reload().Tags()["images"])
    assert {"basin", "images", "warped/by_the_solution", "features/0"} <= pictures
    told = json.loads((folder / "best.json").read_text())
    assert 0 <= told["figures"]["rotation_features_at_twice"] <= 1


@pytest.mark.parametrize(
    ("override", "message"), [("unchanged=2", "unchanged"), ("start_rotation_deg=[3]", "start_rotation_deg: expected")]
)
def test_impossible_settings_are_refused_in_one_sentence(override, message, tmp_path, capsys):
    assert main("features", FeaturesConfig, run, [override, f"out={tmp_path}"]) == 2
    assert message in capsys.readouterr().err


def test_the_reach_lies_where_a_curve_falls_below_the_share():
    assert reach({10: 1.0, 20: 0.9, 30: 0.7}) == pytest.approx(25)
    assert reach({10: 1.0, 20: 0.9}) == 20
    assert reach({10: 0.7, 20: 0.9}) == 0
    assert at({10: 1.0, 20: 0.5}, 15) == pytest.approx(0.75)
    assert at({10: 1.0, 20: 0.5}, 5) == 1.0
    assert at({10: 1.0, 20: 0.5}, 99) == 0.5


def test_intensity_is_compared_at_the_setting_that_is_best_at_each_point(tmp_path):
    def rows(method, light, shares):
        return [
            Row(method, light, ROTATION, size, "all", share, 0.1, 0.001)
            for size, share in zip((10, 20, 40, 80), shares, strict=True)
        ]

    told = [
        *rows("intensity 64", SAME, (1, 0.8, 0, 0)),
        *rows("intensity 16", SAME, (1, 1, 0.8, 0)),
        *rows("intensity 64", OTHER, (0.6, 0.6, 0.1, 0)),
        *rows("intensity 16", OTHER, (0.1, 0.1, 0.1, 0)),
        *rows("spread colour", SAME, (1, 1, 1, 1)),
        *rows("spread colour", OTHER, (0, 0, 0, 0)),
        *rows(FEATURES, SAME, (1, 1, 1, 0.9)),
        *rows(FEATURES, OTHER, (0.9, 0.9, 0.9, 0.7)),
    ]
    told_of = compare(told, ROTATION)
    assert (told_of.reach, told_of.features_twice, told_of.features_twice_other) == pytest.approx((40, 0.9, 0.7))
    assert told_of.lost_intensity == pytest.approx((0.4 + 0.4 + 0.7) / 3)
    assert told_of.lost_features == pytest.approx(0.1)
    report_basin(tmp_path, told)
    assert (tmp_path / "basin.png").stat().st_size > 10_000


def test_raw_intensity_has_a_basin_and_it_ends(pairs):
    aligned = intensity(pairs, AlignConfig(coarsest_width=16, affine=False, backward="none"), colour=False)
    shares = []
    for angle in (0.2, 3.0):
        start = displaced(pairs.T_tgt_ref, angle, 0.02, torch.Generator().manual_seed(0))
        shares.append(float(has_converged(aligned(start), pairs)[0].double().mean()))
    assert shares[0] == 1
    assert shares[1] < 0.5


def test_the_shipped_features_converge_where_intensity_does_not(pairs):
    network = load_checkpoint(SHIPPED_FEATURES)
    generator = torch.Generator().manual_seed(5)
    same = turned(pairs, generator)
    other = same.with_images(same.ref, relit(same.tgt, IlluminationConfig(), generator))
    far = displaced(same.T_tgt_ref, math.radians(110), 0.02, generator)
    near = displaced(same.T_tgt_ref, math.radians(10), 0.02, generator)

    def share(pairs, aligner, start):
        return float(has_converged(aligner(start), pairs)[0].double().mean())

    raw, robust = (AlignConfig(coarsest_width=16, affine=affine, backward="none") for affine in (False, True))
    assert share(same, learned(same, network), far) >= 0.8 > 0.5 > share(same, intensity(same, raw, colour=True), far)
    assert share(other, learned(other, network), near) >= 0.8
    assert share(other, learned(other, network), near) > share(other, intensity(other, robust, colour=True), near)


def test_the_shipped_checkpoint_is_small_and_tells_how_it_came_about():
    assert SHIPPED_FEATURES.with_suffix(".safetensors").stat().st_size < 2e6
    told = json.loads(SHIPPED_FEATURES.with_suffix(".json").read_text())
    assert told["made_by"].startswith("python train/features.py")
    figures = told["figures"]
    for scan in ("rotation", "translation", "both"):
        assert figures[f"{scan}_features_at_twice"] >= 0.8
        assert figures[f"{scan}_lost_by_features"] <= figures[f"{scan}_lost_by_intensity"] / 3
