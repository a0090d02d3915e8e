"""Length and sampling of the verifying simulations, in units of the servo's own: nothing here is in seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.control.retuning import law_for_margins, strength
from servotwin.plant.margins import Margins
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import integral_shares, is_pulled_off
from servotwin.redesign.certified.margins import (
    delays_of,
    laws_within,
    nominal_margins,
    plant_set,
    widened,
    with_margins,
)
from servotwin.redesign.certified.rest_in_gap import coasting_time
from servotwin.redesign.certified.uncertainty import Uncertainty

# In units of 1 / crossover: a loop that approaches through a gap creeps, and hunting shows in the end.
_LENGTH = 150.0
# Decay times of the slowest mode: what is left of it is e^-12.
_DECAYS = 12.0
# Time constants with which a load that floats in its gap coasts to rest: e^-8 is a sixtieth of what counts as rest.
_COASTS = 8.0
_JUDGED = 1.0 / 6.0
# Samples a second, in units of the crossover and of the frequency of the sensitivity peak (both rad/s).
_SAMPLING, _RESONANCE = 12.0, 2.0
_MOST_SAMPLES = 20_000


@dataclass(frozen=True)
class Trial:
    """Duration and sampling of the simulations.

    Parameters
    ----------
    duration, last : float
        s: length of a run from rest with one step of the reference, and of its judged last part.
    rate : float
        Hz, at which errors and voltages are sampled.
    threads : int, optional
        As many as there are processors by default.
    period : float, optional
        s, 1 / crossover of the loop, in which the cost of noise is counted; by default a fixed part of the duration.
    """

    duration: float = 60.0
    last: float = 10.0
    rate: float = 50.0
    threads: int | None = None
    period: float | None = None

    @property
    def half(self) -> Trial:
        """Half as long: enough to rank by cost, which the time soon after the step decides."""
        return replace(self, duration=0.5 * self.duration, last=0.5 * self.last, period=self.unit)

    @property
    def unit(self) -> float:
        """s, in which the cost of noise is counted."""
        return self.duration / _LENGTH if self.period is None else self.period


def trial_for(servo: Plant, uncertainty: Uncertainty, demands: Demands) -> Trial:
    """Trial that a servo needs: long enough for its slowest mode, sampled fast enough for its fastest motion.

    Raises
    ------
    InvalidInput
        No candidate is within the bounds on Ms.
    """
    pulled = is_pulled_off(servo, uncertainty)
    return _trial_for(servo, widened(uncertainty, demands), with_margins(demands), pulled)


@lru_cache(maxsize=16)
def _trial_for(servo: Plant, uncertainty: Uncertainty, demands: Demands, pulled: bool) -> Trial:
    # Runs last until the largest share of the own integral has taken away what the load holds it off: smaller ones
    # would make all runs longer.
    shares = integral_shares(servo, demands, disturbed=pulled)
    laws = laws_within(servo, uncertainty, demands, tuple(sorted({shares[0], shares[-1]})))
    plants = plant_set(servo, uncertainty, servo.controller.sample_rate)
    slowest = min(float(plants.decays(law, delay).min()) for law in laws for delay in delays_of(law, uncertainty))
    loop = nominal_margins(servo, law_for_margins(_reference(servo.controller, laws)))
    crossover = _speed(loop, servo, slowest)
    duration = max(_LENGTH / crossover, _DECAYS / slowest, _COASTS * coasting_time(servo, uncertainty))
    resonance = loop.Ms_omega if loop.Ms_omega < math.inf else 0.0
    rate = min(max(_SAMPLING * crossover, _RESONANCE * resonance), _MOST_SAMPLES / duration)
    sampled = servo.controller.sample_rate
    if sampled is not None:
        rate = sampled / max(1, round(sampled / rate))
    return Trial(duration, _JUDGED * duration, rate, None, 1.0 / crossover)


def _speed(loop: Margins, servo: Plant, slowest: float) -> float:
    """rad/s: the highest crossover; behind a velocity loop, which crosses over first, the bandwidth of the position."""
    if isinstance(servo.controller, Controller):
        return loop.gain_crossovers[-1].omega if loop.gain_crossovers else slowest
    return loop.bandwidth if math.isfinite(loop.bandwidth) else slowest


def _reference(own: AnyController, laws: tuple[AnyController, ...]) -> AnyController:
    """The candidate whose gain is the nearest to the servo's own: the crossover is its."""
    return min(laws, key=lambda law: abs(strength(law) / strength(own) - 1.0) if strength(own) else 0.0)
