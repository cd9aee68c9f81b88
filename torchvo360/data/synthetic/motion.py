"""Paths through a world's free space: smooth, and known in closed form at any time.

The world is z up. An upright camera looks along its heading with x to the right and y down.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import check_choice
from torchvo360.data.synthetic.world import Walkway
from torchvo360.lie import se3, so3_exp

MOTIONS = ("walk", "loop", "turned_loop", "pause", "turn", "turn_first", "rotation", "still")
STOPS = {"pause": 1.5, "turn": 3.0, "turn_first": 3.0}
"""How long a walk stands still, seconds: at the middle, or, for turn_first, from its first frame."""
SPEED = 0.95
"""Walking speed, metres a second."""
RAMP_S = 0.5
"""Time in which a walk comes to a stop, and gets going again."""
TURN_DEG = 240.0
"""Pure rotation of turn and turn_first: at most 96 degrees a second."""
LOOP_TURN_DEG = 150.0
"""How much further to the left the turned loop looks at its end."""
STEPS_HZ = 1.8
"""Steps a second; the sway goes once from left to right every second step."""
UPRIGHT = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""R_world_cam of a level camera that looks along the world's x axis."""


@dataclass(frozen=True)
class Sway:
    """Seeded phases of the slow wander and of the gait."""

    phase: Float64[Tensor, "12"]

    @classmethod
    def of(cls, generator: torch.Generator) -> "Sway":
        """Draw the phases."""
        return cls(torch.rand(12, generator=generator, dtype=torch.float64) * math.tau)

    def wave(self, k: int, angle: Float64[Tensor, "N"]) -> Float64[Tensor, "N"]:
        """Return the k-th sine."""
        return torch.sin(angle + self.phase[k])


def trajectory(
    motion: str,
    walkway: Walkway,
    frames: int,
    fps: float,
    *,
    seed: int = 0,
    yaw_jump_deg: float = 0.0,
    at: Float64[Tensor, "N"] | None = None,
) -> Float64[Tensor, "N 4 4"]:
    """Return the poses T_world_cam of a motion.

    Args:
        motion: `walk` (along the walkway at 0.95 m/s with bob, sway and wander), `loop` (once around the walkway, the
            frame after the last would be the first), `turned_loop` (the same path; the frame after the last would be
            at the first one's place and look 150 deg further left), `pause` (a walk that stands still for 1.5 s at its
            middle), `turn` (a walk that only turns, by 240 deg, for 3 s at its middle), `turn_first` (the same, for the
            first 3 s), `rotation` (about a fixed point) or `still`.
        walkway: The free curve of the world.
        frames: Number of poses.
        fps: Frames a second.
        seed: Start, direction and phases.
        yaw_jump_deg: Extra turn to the left about the vertical inside the two frames at the middle.
        at: Where on the way from frame to frame, 0.5 between the first two; every frame's by default.

    Raises:
        InputError: The motion is another word.
    """
    check_choice("motion", motion, MOTIONS)
    generator = torch.Generator().manual_seed(seed)
    start = math.tau * float(torch.rand((), generator=generator, dtype=torch.float64))
    direction = 1.0 if float(torch.rand((), generator=generator)) < 0.5 else -1.0
    sway = Sway.of(generator)
    index = torch.arange(frames, dtype=torch.float64) if at is None else at
    time = index / fps
    still = torch.zeros_like(time)
    if motion == "still":
        position, yaw, pitch, roll = _upright_at(walkway, start + still), start + still, still, still
    elif motion == "rotation":
        position = _upright_at(walkway, start + still)
        yaw = start + direction * (0.5 * time + 0.15 * sway.wave(0, 1.9 * time))
        pitch = 0.2 * (sway.wave(1, 1.3 * time) - sway.wave(1, still))
        roll = 0.12 * (sway.wave(2, 1.7 * time) - sway.wave(2, still))
    else:
        if motion in ("loop", "turned_loop"):
            # Every wave closes with the loop: a whole number of periods in `frames` frames.
            turn = index / frames
            wander, gait = math.tau * turn, math.tau * turn * max(1, round(frames / fps * STEPS_HZ / 2))
            distance = turn * _circumference(walkway)
        else:
            going = time if motion == "walk" else _time_on_foot(time, *_stop(motion, frames / fps))
            wander, gait = 0.9 * going, math.tau * STEPS_HZ / 2 * going
            distance = SPEED * going
        angle = start + direction * _angle_at(walkway, start, direction, distance)
        position = _upright_at(walkway, angle)
        a, b = walkway.radii
        tangent = torch.stack([-a * angle.sin(), b * angle.cos()], -1) * direction
        heading = torch.atan2(tangent[:, 1], tangent[:, 0])
        left = torch.stack([-heading.sin(), heading.cos(), still], -1)
        position = position + left * (0.02 * sway.wave(0, gait) + 0.04 * sway.wave(1, 2 * wander))[:, None]
        position[:, 2] += 0.022 * sway.wave(2, 2 * gait) + 0.06 * sway.wave(3, wander)
        yaw = heading + 0.12 * sway.wave(4, 2 * wander) + 0.02 * sway.wave(5, gait)
        pitch = 0.08 * sway.wave(6, wander) + 0.012 * sway.wave(7, 2 * gait)
        roll = 0.05 * sway.wave(8, wander) + 0.015 * sway.wave(9, gait)
        if motion == "turned_loop":
            yaw = yaw + math.radians(LOOP_TURN_DEG) * index / frames
        elif motion in ("turn", "turn_first"):
            begin, end = _stop(motion, frames / fps)
            share = ((time - begin) / (end - begin)).clamp(0, 1)
            nod = torch.sin(math.pi * share) ** 2  # and back
            yaw = yaw + direction * math.radians(TURN_DEG) * _turned(share * (end - begin), end - begin)
            pitch = pitch + 0.12 * nod * torch.sin(math.tau * share)
            roll = roll + 0.06 * nod
    middle = frames // 2
    share = ((index - middle + 1) / 2).clamp(0, 1)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)  # half way at the frame between, without a kick for an IMU
    yaw = yaw + math.radians(yaw_jump_deg) * smooth
    return se3(_attitude(yaw, pitch, roll), position)


def _stop(motion: str, duration_s: float) -> tuple[float, float]:
    """Return when a walk stands still, and when it goes on, seconds."""
    begin = 0.0 if motion == "turn_first" else (duration_s - STOPS[motion]) / 2
    return begin, begin + STOPS[motion]


def _time_on_foot(time: Float64[Tensor, "N"], begin: float, end: float) -> Float64[Tensor, "N"]:
    """Return the time at walking speed that makes the way of a walk with a stop."""

    def beside_stop(apart: Float64[Tensor, "N"]) -> Float64[Tensor, "N"]:
        """Integrate the speed 3 x^2 - 2 x^3 of a ramp, and 1 beyond it."""
        x = (apart / RAMP_S).clamp(0, 1)
        return RAMP_S * (x**3 - x**4 / 2) + (apart - RAMP_S).clamp_min(0)

    return beside_stop(time - end) - beside_stop(begin - time) + beside_stop(torch.full_like(time, begin))


def _turned(time: Float64[Tensor, "N"], duration_s: float) -> Float64[Tensor, "N"]:
    """Return the share of a turn done: its speed rises over a ramp, holds, and falls over a ramp."""

    def risen(time: Float64[Tensor, "N"]) -> Float64[Tensor, "N"]:
        x = (time / RAMP_S).clamp(0, 1)
        return RAMP_S * (x**3 - x**4 / 2)

    return (
        risen(time)
        + (time - RAMP_S).clamp(0, duration_s - 2 * RAMP_S)
        + (RAMP_S / 2 - risen(duration_s - time)) * (time > duration_s - RAMP_S)
    ) / (duration_s - RAMP_S)


def _attitude(
    yaw: Float64[Tensor, "N"], pitch: Float64[Tensor, "N"], roll: Float64[Tensor, "N"]
) -> Float64[Tensor, "N 3 3"]:
    """Return R_world_cam of a camera turned left by yaw, then up by pitch, then by roll about its view, radians."""
    x, _, z = torch.eye(3, dtype=yaw.dtype)
    return so3_exp(yaw[:, None] * z) @ UPRIGHT @ so3_exp(pitch[:, None] * x) @ so3_exp(roll[:, None] * z)


def _upright_at(walkway: Walkway, angle: Float64[Tensor, "N"]) -> Float64[Tensor, "N 3"]:
    (x, y), (a, b) = walkway.centre, walkway.radii
    return torch.stack([x + a * angle.cos(), y + b * angle.sin(), torch.full_like(angle, walkway.eye_height)], -1)


def _circumference(walkway: Walkway) -> float:
    angle = torch.linspace(0, math.tau, 4097, dtype=torch.float64)
    return float(torch.linalg.vector_norm(_upright_at(walkway, angle).diff(dim=0), dim=-1).sum())


def _angle_at(walkway: Walkway, start: float, direction: float, distance: Float64[Tensor, "N"]) -> Float64[Tensor, "N"]:
    """Return the angle gone after a distance along the ellipse, by its arc length at 4096 steps a turn.

    Between the steps it is cubic with the true slope at both ends: its rate has no jumps that an IMU would feel.
    """
    whole = _circumference(walkway)
    turn = torch.linspace(0, math.tau, 4097, dtype=torch.float64)
    step = torch.linalg.vector_norm(_upright_at(walkway, start + direction * turn).diff(dim=0), dim=-1)
    gone = torch.cat([step.new_zeros(1), step.cumsum(0)])
    (a, b), angle = walkway.radii, start + direction * turn
    slope = 1 / torch.hypot(a * angle.sin(), b * angle.cos())
    within = distance % whole
    k = torch.searchsorted(gone, within, right=True).clamp(1, len(gone) - 1)
    length = gone[k] - gone[k - 1]
    share = (within - gone[k - 1]) / length
    bend_before = slope[k - 1] * length - (turn[k] - turn[k - 1])
    bend_after = (turn[k] - turn[k - 1]) - slope[k] * length
    bend = share * (1 - share) * (bend_before * (1 - share) + bend_after * share)
    return turn[k - 1] + share * (turn[k] - turn[k - 1]) + bend + math.tau * torch.floor(distance / whole)
