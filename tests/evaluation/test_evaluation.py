import math
from pathlib import Path

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.registration import associate, nearest, similarity_from_points
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.evaluation import evaluate
from torchvo360.lie import se3, se3_exp, sim3_exp, so3_exp

SHARED = Path(__file__).parents[2] / ".." / "shared"


def walk(frames: int = 60, *, seed: int = 0, step_ns: int = 33_333_333, noise: float = 0.0) -> Trajectory:
    """A random smooth path with turns; with noise, the same path with errors that add up."""
    generator = torch.Generator().manual_seed(seed)
    steps = 0.05 * torch.randn(frames, 6, generator=generator, dtype=torch.float64)
    steps[:, 2] += 0.1
    errors = noise * torch.randn(frames, 6, generator=generator, dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64)]
    for step in steps[1:] + errors[1:]:
        poses.append(poses[-1] @ se3_exp(step))
    return Trajectory(torch.arange(frames) * step_ns, torch.stack(poses))


def moved(trajectory: Trajectory, xi: list[float]) -> Trajectory:
    """The trajectory in a world that differs by a similarity with tangent xi: poses stay rigid."""
    S = sim3_exp(torch.tensor(xi, dtype=torch.float64))
    T = S @ trajectory.T_world_cam
    T[:, :3, :3] /= math.exp(xi[-1])
    return Trajectory(trajectory.t_ns, T)


def taken(trajectory: Trajectory, index) -> Trajectory:
    return Trajectory(trajectory.t_ns[index], trajectory.T_world_cam[index])


SIMILARITIES = [[1, -2, 3, 0.4, -2.0, 1.1, 0.9], [0, 0, 0, math.pi, 0, 0, 0], [-5, 1, 0, 0, 0, 0.3, -2.0]]


@pytest.mark.parametrize("xi", SIMILARITIES)
def test_a_similarity_of_the_truth_has_no_error_and_is_found(xi):
    truth = walk()
    result = evaluate(moved(truth, xi), truth)
    assert result.ate_rmse_m < 1e-12
    assert result.rotation_median_deg < 1e-6
    assert result.rpe_rotation_deg < 1e-6
    assert result.rpe_translation_percent < 1e-10
    assert result.scale == pytest.approx(math.exp(-xi[-1]), rel=1e-12)
    S_estimate_truth = sim3_exp(torch.tensor(xi, dtype=torch.float64))
    torch.testing.assert_close(
        result.T_truth_estimate @ S_estimate_truth, torch.eye(4, dtype=torch.float64), atol=1e-10, rtol=0
    )


@pytest.mark.parametrize("xi", SIMILARITIES)
def test_errors_do_not_depend_on_the_world_of_the_estimate(xi):
    truth, estimate = walk(), walk(noise=0.01)
    plain, other = evaluate(estimate, truth), evaluate(moved(estimate, xi), truth)
    for name in ("ate_rmse_m", "ate_percent", "rpe_translation_percent", "rpe_rotation_deg", "rotation_median_deg"):
        assert getattr(plain, name) > 1e-3
        assert getattr(other, name) == pytest.approx(getattr(plain, name), rel=1e-7)


def test_percentages_do_not_depend_on_the_scale_of_the_truth():
    truth, estimate = walk(), walk(noise=0.01)
    plain, larger = evaluate(estimate, truth), evaluate(estimate, moved(truth, [0, 0, 0, 0, 0, 0, math.log(10)]))
    assert larger.ate_rmse_m == pytest.approx(10 * plain.ate_rmse_m)
    assert larger.path_length_m == pytest.approx(10 * plain.path_length_m)
    assert larger.ate_percent == pytest.approx(plain.ate_percent)
    assert larger.rpe_translation_percent == pytest.approx(plain.rpe_translation_percent)


def test_what_align_leaves_open_becomes_an_error():
    truth = walk()
    scaled, shifted = moved(truth, [0, 0, 0, 0, 0, 0, 0.5]), moved(truth, [3, 0, 0, 0, 0, 0, 0])
    assert evaluate(scaled, truth, align="se3").ate_rmse_m > 0.1
    assert evaluate(scaled, truth, align="se3").scale == pytest.approx(1)
    assert evaluate(shifted, truth, align="se3").ate_rmse_m < 1e-12
    assert evaluate(shifted, truth, align="none").ate_rmse_m == pytest.approx(3)
    turned = moved(truth, [0, 0, 0, 0, 0.2, 0, 0])
    assert evaluate(turned, truth, align="none").rotation_median_deg == pytest.approx(math.degrees(0.2))
    assert evaluate(turned, truth, align="se3").rotation_median_deg < 1e-6


def test_a_known_drift_gives_the_known_relative_errors():
    truth = walk(40)
    angle = math.radians(0.1)
    drift = se3_exp(torch.tensor([0, 0, 0, 0, angle, 0], dtype=torch.float64))
    relative = torch.linalg.inv(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    poses = [truth.T_world_cam[0]]
    for T in relative:
        poses.append(poses[-1] @ T @ drift)
    result = evaluate(Trajectory(truth.t_ns, torch.stack(poses)), truth, rpe_frames=1)
    assert result.rpe_rotation_deg == pytest.approx(0.1, rel=1e-6)
    assert evaluate(Trajectory(truth.t_ns, torch.stack(poses)), truth, rpe_frames=10).rpe_rotation_deg > 0.5


@pytest.mark.parametrize("source", ["random", "recorded", "house"])
@pytest.mark.parametrize("align", ["sim3", "se3"])
def test_ate_agrees_with_evo(source, align):
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.sync import associate_trajectories
    from evo.core.trajectory import PoseTrajectory3D

    if source == "random":
        truth, estimate = walk(200, seed=3), moved(walk(200, seed=3, noise=0.02), SIMILARITIES[0])
    elif not (SHARED / "data").is_dir():
        pytest.skip("the shared test data is absent")
    elif source == "recorded":
        truth, estimate = (read_tum(SHARED / f"data/trajectories/{name}.txt") for name in ("groundtruth", "estimated"))
    else:
        truth = read_tum(SHARED / "data/house/poses.txt")
        drift = torch.cumsum(0.002 * torch.randn(len(truth), 6, generator=torch.Generator().manual_seed(1)), 0)
        estimate = Trajectory(truth.t_ns, se3_exp(drift.double()) @ truth.T_world_cam)
    result = evaluate(estimate, truth, align=align)
    evo_truth, evo_estimate = associate_trajectories(
        *(
            PoseTrajectory3D(poses_se3=list(t.T_world_cam.numpy()), timestamps=t.t_ns.numpy() / 1e9)
            for t in (truth, estimate)
        ),
        max_diff=0.016,
    )
    evo_estimate.align(evo_truth, correct_scale=align == "sim3")
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((evo_truth, evo_estimate))
    assert result.pairs == pytest.approx(evo_truth.num_poses, abs=2)
    rmse = ape.get_statistic(metrics.StatisticsType.rmse)
    assert result.ate_rmse_m == pytest.approx(rmse, rel=1e-3 if source == "recorded" else 1e-6)


def test_times_are_paired_within_half_a_frame_and_only_once():
    truth = walk(30, step_ns=100)
    t_ns = torch.arange(30) * 100_000_000
    truth = Trajectory(t_ns, truth.T_world_cam)
    late = Trajectory(t_ns + 40_000_000, truth.T_world_cam)
    i_estimate, i_truth = associate(late, truth)
    assert i_estimate.tolist() == i_truth.tolist() == list(range(30))
    i_estimate, i_truth = associate(Trajectory(t_ns + 60_000_000, truth.T_world_cam), truth)
    assert (i_truth - i_estimate).unique().tolist() == [1]
    fine = Trajectory(torch.arange(300) * 10_000_000, walk(300).T_world_cam)
    i_estimate, i_truth = associate(truth, fine)
    torch.testing.assert_close(i_truth, i_estimate * 10)
    i_estimate, i_truth = associate(fine, truth)
    torch.testing.assert_close(i_estimate, i_truth * 10)


def test_nearest_agrees_with_an_exhaustive_search():
    generator = torch.Generator().manual_seed(0)
    among = torch.randperm(10_000, generator=generator)[:50].sort().values
    t_ns = torch.randint(-2000, 12_000, (500,), generator=generator)
    distance = (t_ns[:, None] - among).abs()
    torch.testing.assert_close((t_ns - among[nearest(t_ns, among)]).abs(), distance.min(-1).values)
    assert nearest(t_ns, among[:1]).unique().tolist() == [0]


def test_coverage_counts_true_frames_within_the_range_of_the_estimate():
    truth = walk(100)
    assert evaluate(truth, truth).coverage == 1
    assert evaluate(taken(truth, slice(20, 60)), truth).coverage == 1
    kept = torch.tensor([i for i in range(100) if not 30 <= i < 55])
    assert evaluate(taken(truth, kept), truth).coverage == pytest.approx(0.75, abs=0.011)
    assert evaluate(taken(truth, slice(0, 100, 3)), truth).coverage == 1
    assert evaluate(taken(truth, slice(0, 100, 2)), truth).coverage == 1
    fine = walk(991, step_ns=3_333_333)
    assert evaluate(Trajectory(fine.t_ns[::10], fine.T_world_cam[::10]), fine).coverage == 1


@pytest.mark.parametrize("still", ["estimate", "truth", "both"])
@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
def test_a_camera_that_stands_still_has_scale_one_and_no_nan(still, align):
    truth, estimate = walk(20), walk(20, noise=0.01)
    if still != "estimate":
        truth.T_world_cam[:, :3, 3] = torch.tensor([4.0, 5.0, 6.0], dtype=torch.float64)
    if still != "truth":
        estimate.T_world_cam[:, :3, 3] = 0
    result = evaluate(estimate, truth, align=align)
    assert result.scale == pytest.approx(1)
    numbers = [value for value in vars(result).values() if isinstance(value, float | int)]
    for figures in (result.ate_m, result.rpe_m, result.rpe_deg, result.rpe_metres_m, result.rpe_metres_deg):
        numbers += [] if figures is None else vars(figures).values()
    assert not any(math.isnan(number) for number in numbers)
    assert bool(torch.isfinite(result.drift.translation_percent).all())
    assert (result.drift.mean_rotation_deg_per_m is None) == (still != "estimate")
    assert bool(torch.isfinite(result.T_truth_estimate).all())
    if still == "both" and align != "none":
        assert result.ate_percent == 0
        assert result.rotation_median_deg < 5


def test_points_on_a_line_and_on_a_plane_are_registered_without_a_mirror():
    R = so3_exp(torch.tensor([0.3, -0.4, 2.5], dtype=torch.float64))
    for dimensions in (1, 2, 3):
        p = torch.zeros(20, 3, dtype=torch.float64)
        p[:, :dimensions] = torch.randn(20, dimensions, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        q = 2 * p @ R.mT + 1
        S = similarity_from_points(p, q)
        assert S is not None
        torch.testing.assert_close(p @ S[:3, :3].mT + S[:3, 3], q)
        assert float(torch.linalg.det(S[:3, :3])) == pytest.approx(8)
    mirrored = p * torch.tensor([1, 1, -1])
    S = similarity_from_points(p, mirrored)
    assert S is not None
    assert float(torch.linalg.det(S[:3, :3])) > 0


def test_no_other_similarity_fits_better():
    p = torch.randn(30, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    q = p @ so3_exp(torch.tensor([1.0, 0.2, -0.5], dtype=torch.float64)).mT * 1.5 + 0.3 * torch.randn(
        30, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64
    )
    S = similarity_from_points(p, q)
    assert S is not None

    def cost(xi):
        moved_p = p @ (sim3_exp(xi) @ S)[:3, :3].mT + (sim3_exp(xi) @ S)[:3, 3]
        return (moved_p - q).square().sum()

    gradient = torch.func.grad(cost)(torch.zeros(7, dtype=torch.float64))
    torch.testing.assert_close(gradient, torch.zeros(7, dtype=torch.float64), atol=1e-10, rtol=0)
    assert float(cost(torch.full((7,), 1e-3, dtype=torch.float64))) > float(cost(torch.zeros(7, dtype=torch.float64)))


def test_too_few_pairs_are_refused_with_both_ranges_of_time():
    truth = walk(30)
    late = Trajectory(truth.t_ns + 10**12, truth.T_world_cam)
    with pytest.raises(
        InputError, match=r"^truth: expected at least 3 poses at times .*1000\.000 s .* got 0 \(0\.000 s"
    ):
        evaluate(late, truth)
    with pytest.raises(InputError, match="got 2"):
        evaluate(taken(truth, slice(0, 2)), truth)
    empty = Trajectory(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, 4, dtype=torch.float64))
    with pytest.raises(InputError, match="no poses"):
        evaluate(empty, truth)
    with pytest.raises(InputError, match="no poses"):
        evaluate(truth, empty)
    assert evaluate(taken(truth, slice(0, 3)), truth).pairs == 3


@pytest.mark.parametrize(("name", "value"), [("align", "sim2"), ("rpe_frames", 0)])
def test_an_argument_out_of_range_is_named(name, value):
    with pytest.raises(InputError, match=f"^{name}: expected"):
        evaluate(walk(), walk(), **{name: value})


def test_a_constant_offset_of_the_world_is_not_an_error_of_the_orientation():
    truth = walk(25)
    R = so3_exp(torch.tensor([0.0, 3.1, 0.2], dtype=torch.float64))
    turned = Trajectory(truth.t_ns, se3(R, torch.zeros(3, dtype=torch.float64)) @ truth.T_world_cam)
    assert evaluate(turned, truth).rotation_median_deg < 1e-6
