"""The time offset between a camera and an IMU, from how both turned.

The camera's turn over half a second is held against the gyro's over the same time, shifted: first on a grid over
all shifts at once, the gyro's bias of each shift being the median difference; then by Gauss-Newton on shift and bias
under Huber's weights. Over such a time the turn differs from that of a shifted one by the change of the angular rate,
many times more than over the time of a frame, and the rotations' errors are the same.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_shape
from torchvo360.inertial.samples import ImuSamples, ImuSensor
from torchvo360.lie import so3_exp, so3_left_jacobian, so3_log

SPAN_S = 0.5
"""Time over which turns are compared."""
GRID_S = 5e-3
FEWEST = 20
"""Turns below which nothing is said."""
STEPS = 10
HUBER = 1.345
"""In deviations: 95 % efficient for normal errors. Source: Huber, "Robust Statistics"."""
MEDIAN_LENGTH = 1.5382
"""Median length of a vector of three standard normal numbers (chi distribution of three degrees)."""
CLIP = 5.0
"""Misfits count up to this many times the best shift's median: beyond it the camera's rotation is wrong."""
MAX_GAP_S = 0.1
"""A turn during which the gyro was silent for longer is left out, seconds."""
ELSEWHERE_S = 0.05
DISTINCT = 1.1
"""A shift is told where every other one, `ELSEWHERE_S` away or more, misses the turns by this factor more."""


@dataclass(frozen=True)
class TimeOffset:
    """The offset between a camera's and an IMU's clocks; where not `ok` it is a guess, and finite."""

    ok: bool
    reason: str
    """Empty, or a sentence why it is not `ok`."""
    offset_s: float
    """Add it to the IMU's times to get the camera's."""
    deviation_s: float
    """Standard deviation."""


def estimate_offset(
    R_world_cam: Float64[Tensor, "N 3 3"],
    t_ns: Int64[Tensor, "N"],
    sensor: ImuSensor,
    *,
    search_s: float = 0.3,
    max_deviation_s: float = 2e-3,
) -> TimeOffset:
    """Estimate the time offset between a camera and an IMU.

    Args:
        R_world_cam: Rotations of the camera, in any world.
        t_ns: Their times, increasing, in the camera's time; 10 a second or more.
        sensor: The IMU; its `offset_s` is the middle of the search.
        search_s: How far from there the offset may be, seconds.
        max_deviation_s: Standard deviation above which the offset counts as not told.

    Raises:
        InputError: The times do not increase, or a setting is not above 0.
        ShapeError: The shapes do not fit.
    """
    N = check_shape("R_world_cam", R_world_cam, "N 3 3")["N"]
    check_shape("t_ns", t_ns, f"{N}")
    if t_ns.dtype != torch.int64 or not bool((t_ns.diff() > 0).all()):
        raise InputError("t_ns: expected increasing times in integer nanoseconds, got others.")
    check_finite_number("search_s", search_s, above=0, at_most=10)
    check_finite_number("max_deviation_s", max_deviation_s, above=0)
    sensor = _during(sensor, t_ns, search_s + STEPS * GRID_S)
    turns = _turns(R_world_cam.double(), t_ns, sensor)
    shifts = torch.arange(-round(search_s / GRID_S), round(search_s / GRID_S) + 1).double() * GRID_S
    gyro = _Gyro.of(sensor.samples, torch.zeros(3, dtype=torch.float64))
    cost, bias = _search(turns, gyro, shifts)
    best = int(cost.argmin())
    if not bool(cost[best].isfinite()):
        return TimeOffset(False, f"The IMU covers fewer than {FEWEST} turns of the camera.", sensor.offset_s, search_s)
    shift, deviation = _refine(turns, sensor.samples, shifts[best], bias[best])
    elsewhere = cost[(shifts - shifts[best]).abs() >= ELSEWHERE_S]
    reason = ""
    if best in (0, len(shifts) - 1) or abs(float(shift)) > search_s:
        reason = f"The time offset is not within {search_s:g} s."
    elif not deviation <= max_deviation_s or bool((elsewhere < DISTINCT * cost[best]).any()):
        reason = "The camera turns too little to tell the time offset."
    return TimeOffset(not reason, reason, sensor.offset_s + float(shift), deviation)


class _Turns(NamedTuple):
    """What the camera saw: the IMU's turns R_start_end between two times, seconds of the IMU's time."""

    poses: Int64[Tensor, "2 K"]
    """Numbers of the two poses of each."""
    start: Float64[Tensor, "K"]
    end: Float64[Tensor, "K"]
    R: Float64[Tensor, "K 3 3"]


def _during(sensor: ImuSensor, t_ns: Int64[Tensor, "N"], margin_s: float) -> ImuSensor:
    """Return the IMU with the samples about the camera's times alone: those of an hour take a minute to integrate."""
    samples = sensor.samples
    if not len(t_ns):
        return sensor
    ends = t_ns[[0, -1]] - round(sensor.offset_s * 1e9) + round(margin_s * 1e9) * t_ns.new_tensor([-1, 1])
    first, last = torch.searchsorted(samples.t_ns, ends).tolist()
    # One more at each end, between which the first and the last are interpolated; two at least.
    first = min(max(first - 1, 0), len(samples) - 2)
    kept = slice(first, max(last + 1, first + 2))
    return replace(sensor, samples=ImuSamples(samples.t_ns[kept], samples.gyro[kept], samples.accel[kept]))


def _turns(R_world_cam: Float64[Tensor, "N 3 3"], t_ns: Int64[Tensor, "N"], sensor: ImuSensor) -> _Turns:
    R_world_imu = R_world_cam @ sensor.T_cam_imu[:3, :3]
    end = torch.searchsorted(t_ns, t_ns + round(SPAN_S * 1e9))
    start = (end < len(t_ns)).nonzero()[:, 0]
    end = end[start]
    time = (t_ns - sensor.samples.t_ns[0]).double() / 1e9 - sensor.offset_s
    return _Turns(torch.stack([start, end]), time[start], time[end], R_world_imu[start].mT @ R_world_imu[end])


class _Gyro(NamedTuple):
    """A gyro's orientation over time, from where it began."""

    time: Float64[Tensor, "M"]
    """Seconds from the first sample."""
    rate: Float64[Tensor, "M 3"]
    R_first: Float64[Tensor, "M 3 3"]
    """R_first_sample."""

    @classmethod
    def of(cls, samples: ImuSamples, bias: Float64[Tensor, "3"]) -> "_Gyro":
        """Integrate the samples less a bias; the products of all first m turns take log2 M steps."""
        time = (samples.t_ns - samples.t_ns[0]).double() / 1e9
        rate = samples.gyro - bias
        R = so3_exp((rate[1:] + rate[:-1]) / 2 * time.diff()[:, None])
        R = torch.cat([torch.eye(3).to(R)[None], R])
        reach = 1
        while reach < len(R):
            R = torch.cat([R[:reach], R[:-reach] @ R[reach:]])
            reach *= 2
        return cls(time, rate, R)

    def at(
        self, time: Float64[Tensor, "*batch"]
    ) -> tuple[Float64[Tensor, "*batch 3 3"], Float64[Tensor, "*batch 3"], Int64[Tensor, "*batch"]]:
        """Return the orientation and the rate at any times, and the sample before each."""
        k = (torch.searchsorted(self.time, time.contiguous(), right=True) - 1).clamp(0, len(self.time) - 2)
        since = (time - self.time[k])[..., None]
        slope = (self.rate[k + 1] - self.rate[k]) / (self.time[k + 1] - self.time[k])[..., None]
        turn = so3_exp((self.rate[k] + slope * since / 2) * since)
        return self.R_first[k] @ turn, self.rate[k] + slope * since, k

    def measured(self, first: Int64[Tensor, "*batch"], last: Int64[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
        """Return whether no gap is between the spans of two samples, both included."""
        gaps = torch.cat([self.time.new_zeros(1), (self.time.diff() > MAX_GAP_S).double()]).cumsum(0)
        return gaps[last + 1] == gaps[first]


class _Misfit(NamedTuple):
    residual: Float64[Tensor, "*batch K 3"]
    """Log(dR^T R), radians."""
    by_shift: Float64[Tensor, "*batch K 3"]
    """Turn by which dR changes on its right with the shift, rad/s."""
    ok: Bool[Tensor, "*batch K"]


def _misfit(turns: _Turns, gyro: _Gyro, shift: Float64[Tensor, "*batch"]) -> _Misfit:
    """Compare the camera's turns with the gyro's, when the IMU's time is the camera's less a further shift."""
    start, end = turns.start - shift[..., None], turns.end - shift[..., None]
    (R_start, w_start, first), (R_end, w_end, last) = gyro.at(start), gyro.at(end)
    dR = R_start.mT @ R_end
    by_shift = (dR.mT @ w_start[..., None])[..., 0] - w_end
    ok = (start >= 0) & (end <= gyro.time[-1]) & gyro.measured(first, last)
    return _Misfit(so3_log(dR.mT @ turns.R), by_shift, ok)


def _search(
    turns: _Turns, gyro: _Gyro, shifts: Float64[Tensor, "S"]
) -> tuple[Float64[Tensor, "S"], Float64[Tensor, "S 3"]]:
    """Return the mean misfit of every shift, rad/s, and the bias that goes with it; inf where it is not measured."""
    if len(turns.start) < FEWEST:
        return torch.full_like(shifts, torch.inf), shifts.new_zeros(len(shifts), 3)
    misfit = _misfit(turns, gyro, shifts)
    rate = misfit.residual / (turns.end - turns.start)[:, None]
    rate = torch.where(misfit.ok[..., None], rate, torch.nan)
    middle = rate.nanmedian(1).values.nan_to_num()
    away = torch.linalg.vector_norm(rate - middle[:, None], dim=-1)
    typical = torch.where(misfit.ok.sum(1) >= FEWEST, away.nanmedian(1).values, torch.inf)
    cost = away.clamp_max(CLIP * typical.min()).nanmean(1)
    return torch.where(typical.isfinite(), cost, torch.inf), -middle


def _refine(
    turns: _Turns, samples: ImuSamples, shift: Float64[Tensor, ""], bias: Float64[Tensor, "3"]
) -> tuple[Float64[Tensor, ""], float]:
    """Return the shift and its standard deviation."""
    deviation = torch.inf
    dt = (turns.end - turns.start)[:, None, None]
    for _ in range(STEPS):
        misfit = _misfit(turns, _Gyro.of(samples, bias), shift)
        r, ok = misfit.residual, misfit.ok
        inverse = torch.linalg.inv(so3_left_jacobian(r))  # Log(Exp(-d) E) = Log(E) - inverse d
        J = -inverse @ torch.cat([misfit.by_shift[..., None], -dt * torch.eye(3).to(r)], -1)
        size = torch.linalg.vector_norm(r, dim=-1)
        sigma = (size[ok].median() / MEDIAN_LENGTH).clamp_min(1e-9)
        weight = ok * (HUBER * 3**0.5 * sigma / size.clamp_min(1e-12)).clamp_max(1)
        normal = (J.mT @ (weight[:, None, None] * J)).sum(0)
        factor, failed = torch.linalg.cholesky_ex(normal)
        if int(failed) != 0:
            return shift, torch.inf
        gradient = (J.mT @ (weight[:, None] * r)[..., None]).sum(0)
        step = -torch.cholesky_solve(gradient, factor)[:, 0]
        shift, bias = shift + step[0].clamp(-GRID_S, GRID_S), bias + step[1:]
        deviation = _deviation(turns, weight[:, None, None] * J, torch.cholesky_inverse(factor), sigma)
    return shift, deviation


def _deviation(
    turns: _Turns, WJ: Float64[Tensor, "K 3 4"], inverse: Float64[Tensor, "4 4"], sigma: Float64[Tensor, ""]
) -> float:
    """Return the shift's standard deviation when the errors are those of poses, each in up to two turns."""
    by_pose = WJ.new_zeros(int(turns.poses.max()) + 1, 3, 4)
    by_pose.index_add_(0, turns.poses[1], WJ)
    by_pose.index_add_(0, turns.poses[0], -(turns.R @ WJ))
    spread = (by_pose.mT @ by_pose).sum(0) * sigma.square() / 2
    return float((inverse @ spread @ inverse)[0, 0].sqrt())
