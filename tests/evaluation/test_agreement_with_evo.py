"""Agreement with evo to 1e-6: association in time, alignment, ATE, and RPE over poses and over metres."""

import math
from pathlib import Path

import pytest
import torch

from torchvo360.data.registration import associate, time_tolerance_ns
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.evaluation import Evaluation, Statistics, evaluate
from torchvo360.lie import se3_exp, sim3_exp

metrics = pytest.importorskip("evo.core.metrics", reason="agreement with evo needs the extra `eval`")

from evo.core.sync import matching_time_indices  # noqa: E402
from evo.core.trajectory import PoseTrajectory3D  # noqa: E402


def random_pair() -> tuple[Trajectory, Trajectory]:
    """A true path, and an estimate of it with jitter in time, holes, errors that add up and another world."""
    generator = torch.Generator().manual_seed(7)
    steps = 0.05 * torch.randn(300, 6, generator=generator, dtype=torch.float64)
    steps[:, 2] += 0.1
    errors = 0.005 * torch.randn(300, 6, generator=generator, dtype=torch.float64)
    true, estimated = [torch.eye(4, dtype=torch.float64)], [torch.eye(4, dtype=torch.float64)]
    for step, error in zip(steps[1:], errors[1:], strict=True):
        true.append(true[-1] @ se3_exp(step))
        estimated.append(estimated[-1] @ se3_exp(step + error))
    t_ns = 10**9 + torch.arange(300) * 33_333_333
    jitter_ns = torch.randint(-9_000_000, 9_000_000, (300,), generator=generator)
    S = sim3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, 2.0, -0.4, -0.2], dtype=torch.float64))
    T = S @ torch.stack(estimated)
    T[:, :3, :3] /= math.exp(-0.2)
    kept = torch.rand(300, generator=generator) < 0.8
    return Trajectory((t_ns + jitter_ns)[kept], T[kept]), Trajectory(t_ns, torch.stack(true))


@pytest.fixture(params=["random", "recorded"])
def pair(request) -> tuple[Trajectory, Trajectory]:
    """An estimate and its truth."""
    if request.param == "random":
        return random_pair()
    folder = request.getfixturevalue("shared") / "data" / "trajectories"
    return read_tum(Path(folder, "estimated.txt")), read_tum(Path(folder, "groundtruth.txt"))


def as_evo(trajectory: Trajectory, index: torch.Tensor) -> PoseTrajectory3D:
    poses, t_ns = trajectory.T_world_cam[index], trajectory.t_ns[index]
    return PoseTrajectory3D(poses_se3=list(poses.numpy()), timestamps=t_ns.numpy() / 1e9)


def both(pair, align: str, **options) -> tuple[Evaluation, PoseTrajectory3D, PoseTrajectory3D]:
    """Our evaluation, and evo's true and aligned trajectories over the same pairs."""
    estimate, truth = pair
    i_estimate, i_truth = associate(estimate, truth)
    evo_truth, evo_estimate = as_evo(truth, i_truth), as_evo(estimate, i_estimate)
    if align != "none":
        evo_estimate.align(evo_truth, correct_scale=align == "sim3")
    return evaluate(estimate, truth, align=align, **options), evo_truth, evo_estimate


def assert_same(ours: Statistics | None, evos) -> None:
    assert ours is not None
    assert ours.count == len(evos.error)
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, name) == pytest.approx(
            evos.get_statistic(metrics.StatisticsType[name]), rel=1e-6, abs=1e-9
        )


def test_poses_are_paired_as_evo_pairs_them(pair):
    estimate, truth = pair
    i_estimate, i_truth = associate(estimate, truth)
    seconds = [trajectory.t_ns.numpy() / 1e9 for trajectory in pair]
    theirs = matching_time_indices(*seconds, max_diff=time_tolerance_ns(estimate) / 1e9)
    assert [i_estimate.tolist(), i_truth.tolist()] == list(map(list, theirs))


@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
def test_ate_is_evos(pair, align):
    result, evo_truth, evo_estimate = both(pair, align)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((evo_truth, evo_estimate))
    assert_same(result.ate_m, ape)
    assert result.ate_rmse_m == result.ate_m.rmse


@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
@pytest.mark.parametrize("frames", [1, 10])
def test_rpe_over_poses_is_evos(pair, align, frames):
    result, evo_truth, evo_estimate = both(pair, align, rpe_frames=frames)
    for relation, ours in (("translation_part", result.rpe_m), ("rotation_angle_deg", result.rpe_deg)):
        rpe = metrics.RPE(metrics.PoseRelation[relation], frames, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((evo_truth, evo_estimate))
        assert_same(ours, rpe)


@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
@pytest.mark.parametrize("metres", [0.5, 2.0])
def test_rpe_over_metres_is_evos(pair, align, metres):
    result, evo_truth, evo_estimate = both(pair, align, rpe_metres=metres)
    figures = (("translation_part", result.rpe_metres_m), ("rotation_angle_deg", result.rpe_metres_deg))
    for relation, ours in figures:
        rpe = metrics.RPE(
            metrics.PoseRelation[relation], metres, metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
        )
        rpe.process_data((evo_truth, evo_estimate))
        assert_same(ours, rpe)
