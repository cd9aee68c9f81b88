"""The odometry with a depth network: metres from the first frame on, and no harm where the network is no help."""

import json
from functools import partial

import pytest
import torch
from torch import Tensor, nn

from torchvo360.checks import InputError
from torchvo360.cli import main
from torchvo360.data.frame import Frame
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import Evaluation, evaluate
from torchvo360.learn.checkpoint import SHIPPED_DEPTH
from torchvo360.learn.depth import PanoramaDepth
from torchvo360.learn.plugin import RangeEstimate
from torchvo360.vo import LEARNED, OdometryResult, State, VisualOdometry

FRAMES = 32
SETTINGS = SyntheticConfig(world="room", seed=5, frames=FRAMES, width=256, height=128)


class Oracle(nn.Module):
    """The true ranges of the frames it has been shown, times a factor, known to a tenth."""

    def __init__(self, *shown: tuple[SyntheticSequence, list[Frame]], factor: float = 1.0) -> None:
        super().__init__()
        self._factor = factor
        self._known = {
            frame.image.tobytes(): partial(sequence.range, frame.index)
            for sequence, frames in shown
            for frame in frames
            if frame.image is not None
        }

    def forward(self, image: Tensor) -> RangeEstimate:
        pixels = (image[0].permute(1, 2, 0) * 255).round().to(torch.uint8).contiguous().numpy()
        rho = (1 / self._known[pixels.tobytes()]() / self._factor).clamp_min(1e-3)[None]
        return RangeEstimate(rho, (0.1 * rho).square())


class Same(nn.Module):
    """One range everywhere."""

    def __init__(self, range_m: float, claims: float) -> None:
        super().__init__()
        self._rho, self._claims = 1 / range_m, claims

    def forward(self, image: Tensor) -> RangeEstimate:
        rho = torch.full_like(image[:, 0], self._rho)
        return RangeEstimate(rho, (self._claims * rho).square())


class Flat(nn.Module):
    def forward(self, image: Tensor) -> RangeEstimate:
        return RangeEstimate(image[:, 0, 0] + 1, image[:, 0, 0] + 1)


class Blind(nn.Module):
    def forward(self, image: Tensor) -> RangeEstimate:
        return RangeEstimate(image[:, 0] * torch.nan, image[:, 0] + 1)


@pytest.fixture(scope="module")
def walk() -> SyntheticSequence:
    return SyntheticSequence(SETTINGS)


@pytest.fixture(scope="module")
def frames(walk):
    return list(walk)


def run(walk, frames, depth: nn.Module | None) -> OdometryResult:
    odometry = VisualOdometry(walk.camera, depth=depth)
    for frame in frames:
        odometry.step(frame)
    return odometry.finish()


def errors(walk, result: OdometryResult) -> Evaluation:
    return evaluate(result.trajectory, walk.truth)


@pytest.fixture(scope="module")
def without(walk, frames) -> OdometryResult:
    return run(walk, frames, None)


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_the_unit_is_the_networks_metre(walk, frames, without, factor):
    figures = errors(walk, run(walk, frames, Oracle((walk, frames), factor=factor)))
    assert abs(figures.scale * factor - 1) < 0.03
    assert figures.ate_percent < 1.2 * errors(walk, without).ate_percent + 0.02


def test_every_frame_is_tracked_and_has_its_translation_at_once(walk, frames):
    odometry = VisualOdometry(walk.camera, depth=Oracle((walk, frames)))
    online = [odometry.step(frame) for frame in frames[:12]]
    assert [estimate.state for estimate in online] == [State.TRACKING] * 12
    assert online[0].reason == LEARNED
    moved = torch.stack([estimate.T_world_cam[:3, 3] for estimate in online]).diff(dim=0).norm(dim=1)
    true = walk.truth.T_world_cam[:12, :3, 3].diff(dim=0).norm(dim=1)
    torch.testing.assert_close(moved[0], true[0], rtol=0.1, atol=0)
    assert bool(((moved / true - 1).abs() < 0.5).all())


def test_a_network_that_is_sure_of_nothing_changes_nothing(walk, frames, without):
    result = run(walk, frames, Same(3.0, claims=0.5))
    assert torch.equal(result.trajectory.T_world_cam, without.trajectory.T_world_cam)
    assert [estimate.reason for estimate in result.frames] == [estimate.reason for estimate in without.frames]


@pytest.mark.parametrize("range_m", [0.3, 30.0])
def test_a_network_that_is_sure_and_wrong_does_not_spoil_the_accuracy(walk, frames, without, range_m):
    result = run(walk, frames, Same(range_m, claims=0.1))
    assert errors(walk, result).ate_percent < 1.5 * errors(walk, without).ate_percent + 0.05
    assert result.frames[-1].state == State.TRACKING


def test_after_a_loss_the_new_map_is_in_metres_too(walk, frames):
    other = SyntheticSequence(SyntheticConfig(**{**vars(SETTINGS), "world": "courtyard", "seed": 3}))
    moved = list(other)
    images = [frame.image for frame in (*frames[:10], *moved)]
    odometry = VisualOdometry(walk.camera, depth=Oracle((walk, frames), (other, moved)))
    for index, image in enumerate(images):
        odometry.step(Frame(index, index * 33_333_333, image))
    result = odometry.finish()
    states = [estimate.state for estimate in result.frames]
    assert State.LOST in states
    assert result.frames[-1].state == State.TRACKING
    T, true = result.trajectory.T_world_cam[-10:], other.truth.T_world_cam[-10:]
    step = [pose[:, :3, 3].diff(dim=0).norm(dim=1).sum() for pose in (T, true)]
    assert abs(float(step[0] / step[1]) - 1) < 0.05


@pytest.mark.parametrize(
    ("network", "complaint"),
    [(Flat(), r"rho: expected shape \[1, 128, 256\]"), (Blind(), "rho: expected finite values")],
)
def test_a_network_that_gives_no_ranges_is_refused_by_name(walk, frames, network, complaint):
    odometry = VisualOdometry(walk.camera, depth=network)
    with pytest.raises(InputError, match=rf"depth .*{type(network).__name__}.*{complaint}"):
        odometry.step(frames[0])


def test_the_shipped_kind_of_network_refuses_what_is_no_panorama():
    pinhole = SyntheticSequence(SyntheticConfig(camera="pinhole", width=128, height=96, frames=1))
    with pytest.raises(InputError, match="expected a full panorama, twice as wide as high, got 128 x 96"):
        VisualOdometry(pinhole.camera, depth=PanoramaDepth(64, (8, 8))).step(pinhole.frame(0))


SYNTHETIC = ["input=synthetic", "synthetic.width=256", "synthetic.height=128", "synthetic.frames=10", "out=results"]


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (["depth.checkpoint=nowhere.safetensors"], "depth.checkpoint: expected a readable file"),
        (["depth._target_=nowhere.Net"], "depth._target_: expected an importable class"),
        (["depth._target_=torch.nn.Identity"], "expected a RangeEstimate"),
        (["depth.checkpoint=foreign.safetensors"], "depth.checkpoint: expected"),
        (["depth.arguments={width: 64}"], "depth.arguments: expected none but for a _target_"),
        (["depth.checkpoint=''"], "depth.checkpoint: expected a file"),
    ],
)
def test_the_command_refuses_a_network_that_cannot_be_used(tmp_path, monkeypatch, capsys, overrides, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "foreign.safetensors").write_bytes(b"foreign")
    (tmp_path / "foreign.json").write_text('{"_target_": "torchvo360.learn.depth.PanoramaDepth"}')
    assert main([*SYNTHETIC, *overrides]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(("claims", "is_sure"), [(0.1, True), (0.5, False)])
def test_the_command_takes_a_network_of_ones_own_and_says_where_it_is_not_sure(
    tmp_path, monkeypatch, capsys, claims, is_sure
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_depth.py").write_text(
        "import torch\n"
        "class Net(torch.nn.Module):\n"
        "    def __init__(self, claims):\n"
        "        super().__init__()\n"
        "        self.claims = claims\n"
        "    def forward(self, image):\n"
        "        rho = torch.full_like(image[:, 0], 0.4)\n"
        "        return rho, (self.claims * rho) ** 2\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    network = ["depth._target_=own_depth.Net", f"depth.arguments={{claims: {claims}}}"]
    assert main([*SYNTHETIC, *network, "plot=false"]) == 0
    assert (LEARNED in (tmp_path / "results" / "frames.csv").read_text()) == is_sure
    assert ("the unit is not its metre" in capsys.readouterr().out) != is_sure


@pytest.mark.slow
@pytest.mark.parametrize(("world", "seed"), [("room", 41), ("pillars", 42), ("courtyard", 43)])
def test_the_shipped_network_knows_the_metre_of_worlds_it_has_not_seen(tmp_path, monkeypatch, world, seed):
    monkeypatch.chdir(tmp_path)
    settings = [f"synthetic.world={world}", f"synthetic.seed={seed}", "synthetic.frames=24", "plot=false"]
    assert main([*SYNTHETIC[:3], *settings, "depth=learned", "out=results"]) == 0
    summary = (tmp_path / "results" / "summary.json").read_text()
    scale = json.loads(summary)["scale"]
    assert abs(1 / scale - 1) < 0.1


def test_the_shipped_network_is_small():
    assert SHIPPED_DEPTH.with_suffix(".safetensors").stat().st_size < 2_000_000
