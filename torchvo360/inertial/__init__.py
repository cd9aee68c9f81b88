"""Inertial measurements: preintegration between two times, and what links them to a camera's motion."""

from torchvo360.inertial.samples import ImuNoise, ImuSamples, ImuSensor

__all__ = ["ImuNoise", "ImuSamples", "ImuSensor"]
