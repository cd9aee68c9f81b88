"""train/depth.py: exact changes of panoramas, batches that are functions of the step, and range learned both ways."""

import csv
import functools
import json
from pathlib import Path

import pytest
import torch

import depth
from command import main
from odometry import Walk, WalksConfig, figures_of, walk_through
from ranges import Neighbours, NeighboursConfig, TrueRanges
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.synthetic.rays import CameraRays
from torchvo360.learn import TrainerConfig, load_checkpoint
from torchvo360.learn.depth import PanoramaDepth
from views import AppearanceConfig, Batch, Views, repainted, turned
from worlds import HALL, ViewsConfig, places, world_of

WIDTH = 64
CAMERA = Equirectangular(WIDTH, WIDTH // 2)
SMALL = {"kinds": ["room"], "walking": 2, "anywhere": 1}


@pytest.fixture(autouse=True, scope="module")
def _worlds_are_made_once():
    """A world takes longer to make than all that is rendered in it here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("views.world_of", functools.cache(world_of))
        yield


def small_network() -> PanoramaDepth:
    torch.manual_seed(0)
    return PanoramaDepth(WIDTH, (8, 16))


def parts(steps: int, worlds: int = 2, **trainer) -> tuple:
    """Settings of a small experiment."""
    config = TrainerConfig(steps=steps, batch_size=4, learning_rate=3e-3, warmup_steps=5, **trainer)
    views = ViewsConfig(**SMALL, worlds=worlds)
    held_back = ViewsConfig(**SMALL, worlds=1, first_seed=20_000_000)
    return small_network(), config, views, held_back, AppearanceConfig()


def taught(experiment, steps: int) -> dict[str, float]:
    """Take steps by hand, and return the figures before and after."""
    optimizer = torch.optim.AdamW(experiment.module.parameters(), experiment.trainer.learning_rate)
    for step in range(steps):
        optimizer.zero_grad()
        experiment.losses(experiment.module, experiment.batch(step, 0, 1))["loss"].backward()
        optimizer.step()
    with torch.no_grad():
        return experiment.validate(experiment.module)


# Worlds and views


@pytest.mark.parametrize("seed", [0, 1])
def test_a_halls_views_stand_free_and_look_apart_by_the_given_distance(seed):
    config = ViewsConfig(kinds=[HALL], worlds=1, walking=3, anywhere=3, neighbour_m=0.2)
    world = world_of(HALL, seed)
    T = places(world, seed, config)
    assert T.shape == (6, 3, 4, 4)
    assert bool((world.clearance(T[:, 0, :3, 3]) > 0.3).all())
    away = (T[:, 1:, :3, 3] - T[:, :1, :3, 3]).norm(dim=-1)
    assert bool(((away > 0.1) & (away < 0.3)).all())
    image, reach = world.render(CameraRays.of(CAMERA), T[:, 0])
    assert bool(((image >= 0) & (image <= 1)).all())
    assert bool((reach > 0).all())


def test_halls_are_of_many_sizes_and_equal_for_equal_seeds():
    first, second, again = (world_of(HALL, seed).solids for seed in (0, 1, 0))
    assert first.half[0].tolist() != second.half[0].tolist()
    assert torch.equal(first.centre, again.centre)


def test_turning_and_mirroring_move_image_and_range_together():
    batch = Batch(torch.rand(3, 2, 3, 8, 16), torch.rand(3, 8, 16))
    shift, mirrored = torch.tensor([0, 5, 3]), torch.tensor([False, False, True])
    out = turned(batch, shift, mirrored)
    assert torch.equal(out.image[0], batch.image[0])
    assert torch.equal(out.image[1], batch.image[1].roll(-5, -1))
    assert torch.equal(out.rho[1], batch.rho[1].roll(-5, -1))
    assert torch.equal(out.rho[2], batch.rho[2].roll(-3, -1).flip(-1))
    assert torch.equal(out.image[2], batch.image[2].roll(-3, -1).flip(-1))


def test_no_change_of_appearance_leaves_the_image():
    image = torch.rand(2, 1, 3, 8, 16) * 0.9 + 0.05
    nothing = AppearanceConfig(log_gain=0, log_gamma=0, offset=0, log_white=0, noise=0, blur=0)
    torch.testing.assert_close(repainted(image, nothing, torch.Generator().manual_seed(0)), image)
    changed = repainted(image, AppearanceConfig(), torch.Generator().manual_seed(0))
    assert bool(((changed >= 0) & (changed <= 1)).all())
    assert float((changed - image).abs().mean()) > 0.02


def test_a_batch_is_a_function_of_its_step_whatever_came_before():
    first, second = TrueRanges(*parts(1), common_error=1.0), TrueRanges(*parts(1), common_error=1.0)
    for step in range(3):
        first.batch(step, 0, 1)
    for a, b in zip(first.batch(7, 0, 1), second.batch(7, 0, 1), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(first.batch(8, 0, 1)[1], second.batch(7, 0, 1)[1])


def test_processes_share_a_batch():
    experiment = TrueRanges(*parts(1), common_error=1.0)
    whole = experiment.batch(3, 0, 1)
    shares = zip(*(experiment.batch(3, part, 2) for part in range(2)), strict=True)
    for joint, parts_of_it in zip(whole, shares, strict=True):
        assert torch.equal(torch.cat(parts_of_it), joint)


# Learning


def test_range_is_learned_from_true_ranges():
    experiment = TrueRanges(*parts(120), common_error=1.0)
    with torch.no_grad():
        before = experiment.validate(experiment.module)
    after = taught(experiment, 120)
    assert after["log_error"] < 0.8 * before["log_error"]
    assert 0.5 < after["surprise"] < 2.0


def test_range_is_learned_without_true_ranges():
    """The deviation of log rho within a view falls, though no true range has been seen."""
    experiment = Neighbours(*parts(60), config=NeighboursConfig())
    take = experiment.batch

    def blind(step: int, part: int, count: int):
        image, rho = take(step, part, count)
        return image, torch.full_like(rho, torch.nan)

    experiment.batch = blind
    with torch.no_grad():
        before = experiment.validate(experiment.module)
    after = taught(experiment, 60)
    assert after["photometric"] < 0.8 * before["photometric"]
    assert after["shape_error"] < 0.9 * before["shape_error"]


def test_the_poses_gradient_reaches_the_ranges():
    """Through the pose alone: the layer's implicit gradient by rho, which `none` cuts."""
    found = {}
    for backward in ("implicit", "none"):
        experiment = Neighbours(*parts(1), config=NeighboursConfig(backward=backward))
        losses = experiment.losses(experiment.module, experiment.batch(0, 0, 1))
        assert float(losses["converged"]) > 0.5
        losses["photometric"].backward()
        found[backward] = experiment.module.exit.bias.grad.clone()
    assert bool(found["implicit"].isfinite().all())
    assert not torch.equal(found["implicit"], found["none"])


# The script

SETTINGS = [
    "network.width=64", "network.channels=[8,16]", "views.worlds=1", "views.walking=2", "views.anywhere=0",
    "held_back.worlds=1", "held_back.walking=1", "trainer.steps=2", "trainer.batch_size=2", "trainer.progress=false",
]  # fmt: skip


@pytest.mark.parametrize("mode", ["supervised", "neighbours"])
def test_the_script_leaves_a_checkpoint_with_its_command_and_figures(tmp_path, capsys, mode):
    walks = ["walks.worlds=[room]", "walks.seeds=[1]", "walks.frames=4"]
    out = tmp_path / "out"
    assert main("depth", depth.DepthTraining, depth.run, [*SETTINGS, *walks, f"mode={mode}", f"out={out}"]) == 0
    assert "scale off by" in capsys.readouterr().out
    beside = json.loads((out / "best.json").read_text())
    assert beside["made_by"].startswith("python train/depth.py")
    assert {"log_error", "scale_worst", "walk_scale_error", "walk_ate_percent_without"} <= beside["figures"].keys()
    assert isinstance(load_checkpoint(out / "best.safetensors"), PanoramaDepth)
    with (out / "walks.csv").open() as file:
        assert [row["seed"] for row in csv.DictReader(file)] == ["1"]


def test_learning_goes_on_from_a_checkpoint(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    quick = [*SETTINGS, "walks.frames=0"]
    assert main("depth", depth.DepthTraining, depth.run, [*quick, f"out={first}"]) == 0
    start = f"start={first / 'last.safetensors'}"
    more = ["trainer.steps=1", "trainer.learning_rate=1e-9"]
    assert main("depth", depth.DepthTraining, depth.run, [*quick, *more, start, f"out={second}"]) == 0
    image = torch.rand(1, 3, 32, 64)
    one, two = (load_checkpoint(folder / "last")(image).rho for folder in (first, second))
    torch.testing.assert_close(two, one, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (["mode=guess"], "mode"),
        (["views.kinds=[cave]"], "kinds: expected one of hall, room"),
        (["views.walking=-1"], "walking, anywhere: expected no negative number"),
        (["held_back.first_seed=10000000"], "held_back.first_seed: expected worlds outside"),
        (["walks.frames=2"], "frames: expected at least 3"),
        (["appearance.noise=-1"], "noise: expected a finite number"),
        (["neighbours.range_m=0"], "range_m: expected a finite number"),
    ],
)
def test_the_script_refuses_what_it_cannot_do_and_leaves_no_folder(tmp_path, monkeypatch, capsys, overrides, complaint):
    monkeypatch.chdir(tmp_path)
    assert main("depth", depth.DepthTraining, depth.run, [*SETTINGS, *overrides, "out=results"]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1
    assert not Path("results").exists()


def test_a_start_that_is_no_checkpoint_is_refused(tmp_path):
    config = depth.DepthTraining(start=str(tmp_path / "missing"), held_back=ViewsConfig(first_seed=0))
    with pytest.raises(InputError, match="checkpoint: expected a readable file"):
        depth.experiment(config)


# The odometry


def test_walks_are_summed_up_by_median_and_worst():
    walks = [Walk("room", seed, error, 0.1, 0.2, 0) for seed, error in enumerate((0.01, -0.05, 0.02))]
    figures = figures_of(walks)
    assert figures["walk_scale_error"] == pytest.approx(0.02)
    assert figures["walk_scale_error_worst"] == pytest.approx(0.05)


def test_a_network_that_is_not_sure_leaves_the_odometry_as_it_is():
    (walk,) = walk_through(small_network(), WalksConfig(worlds=["room"], seeds=[1], frames=8))
    assert walk.ate_percent == walk.ate_percent_without


def test_views_are_kept_once_rendered():
    views = Views(ViewsConfig(**SMALL, worlds=1), CAMERA, neighbours=True)
    again = views.take([0, 2])
    assert again.image.shape == (2, 3, 3, WIDTH // 2, WIDTH)
    assert torch.equal(views.take([2]).image[0], again.image[1])
