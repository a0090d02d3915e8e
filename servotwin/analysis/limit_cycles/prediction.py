"""Limit cycles that a describing function predicts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Prediction:
    """A limit cycle by a describing function: a solution of N(A) L(j omega) = -1.

    Attributes
    ----------
    frequency : float
        Hz.
    motor_amplitude : float
        rad, of the first harmonic of the input of the backlash, A: the motor's angle, or of a free shaft the angle
        across backlash and shaft.
    amplitude : float
        m (rotary: rad), of the first harmonic of the position.
    stable : bool
        True when a larger amplitude would decay and a smaller one grow, by the describing function.
    """

    frequency: float
    motor_amplitude: float
    amplitude: float
    stable: bool
