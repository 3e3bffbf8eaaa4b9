"""How far actuators and sensors of a deployment are off, as data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ErrorsDecl:
    """How far actuators and sensors are off, as shares.

    Attributes:
        actuator_gain: of every control each agent gets so much more or less than it commands, all the time;
            a direction (squash `angle`) is off by this share of a radian instead.
        actuator_noise: standard deviation of what is added to controls at every step, of half their range.
        sensor_noise: of what is added to the real states that agents see, of their nominal range; clocks,
            which are states in seconds, are known.
    """

    actuator_gain: float = 0.0
    actuator_noise: float = 0.0
    sensor_noise: float = 0.0
