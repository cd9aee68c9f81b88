"""Inertial measurements: preintegration between two times, and what links them to a camera's motion."""

from torchvo360.inertial.initialise import InertialStart, InertialStartConfig, initialise
from torchvo360.inertial.offset import TimeOffset, estimate_offset
from torchvo360.inertial.predict import predict
from torchvo360.inertial.preintegration import compose, preintegrate
from torchvo360.inertial.samples import GRAVITY, ImuSamples, ImuSensor
from torchvo360.residuals.inertial import ImuNoise, Preintegrated

__all__ = [
    "GRAVITY",
    "ImuNoise",
    "ImuSamples",
    "ImuSensor",
    "InertialStart",
    "InertialStartConfig",
    "Preintegrated",
    "TimeOffset",
    "compose",
    "estimate_offset",
    "initialise",
    "predict",
    "preintegrate",
]
