"""The machine's own numbers, learnt across windows: stiffness and damping over the masses, pitch, mass ratio.

A nameplate is off by percents, and an estimate of the gap by whole degrees with it. Every window whose estimate counts
narrows what is known of the machine; time widens it again, slowly: a gap wears, a structure hardly does, and that is
what tells the two apart. A machine that contradicts what was learnt (another screw, another load, another machine under
the same name) yields no estimate until some windows in a row agree on its new numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from servotwin.config.keys import check, key, settings
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus, MachineReading
from servotwin.estimation.whitened.free_model import FACTORS, FactorPrior
from servotwin.plant.signals import Array

_SIZE = len(FACTORS)
_DAY_S = 86400.0
_AGREEMENT = 4.0  # standard deviations, of the distance of two readings with as many degrees of freedom as factors
_LEAST_INFORMATION = 1e-2  # of the prior's variance: along directions that shrink by less, the window shows nothing
_DRIFT = 5.0  # the same, of a window's own reading from what was learnt: above it the model's drift is an alarm


@settings("learning")
@dataclass(frozen=True)
class LearningSettings:
    """Settings of the learning of the machine's stiffness, damping, pitch and mass ratio.

    How far they may be off at first is stated by `k_percent`, `c_percent` and `m_percent` of the uncertainty; of a
    shaft that is free in the gap by `OutputErrorSettings`.
    """

    learn: Annotated[
        bool,
        key(
            help="Learn the machine's numbers from its windows; false: nothing is carried from one window to the next."
        ),
    ] = True
    pitch: Annotated[
        float, key("pitch_percent", above=0.0, below=1.0, help="Standard deviation of the pitch before any window.")
    ] = 0.01
    k_drift: Annotated[
        float,
        key("k_drift_per_sqrt_day", minimum=0.0, help="Random walk of the stiffness over the masses, relative."),
    ] = 0.001
    c_drift: Annotated[
        float, key("c_drift_per_sqrt_day", minimum=0.0, help="Random walk of the damping over the masses, relative.")
    ] = 0.01
    k_floor: Annotated[
        float,
        key(
            "k_floor_percent",
            above=0.0,
            help="Smallest standard deviation of stiffness over mass, however many windows.",
        ),
    ] = 2e-4
    c_floor: Annotated[
        float,
        key(
            "c_floor_percent", above=0.0, help="Smallest standard deviation of damping over mass, however many windows."
        ),
    ] = 1e-3
    pitch_floor: Annotated[
        float,
        key("pitch_floor_percent", above=0.0, help="Smallest standard deviation of the pitch, however many windows."),
    ] = 1e-4
    ratio_floor: Annotated[
        float,
        key(
            "mass_ratio_floor_percent",
            above=0.0,
            help="Smallest standard deviation of the mass ratio, however many windows.",
        ),
    ] = 1e-3
    motor: Annotated[
        float,
        key(
            "motor_percent",
            above=0.0,
            below=1.0,
            help="Smallest standard deviation of the motor's lag (J R / k_T) before any window.",
        ),
    ] = 0.05
    motor_drift: Annotated[
        float,
        key("motor_drift_per_sqrt_day", minimum=0.0, help="Random walk of the motor's back EMF and lag, relative."),
    ] = 0.005
    motor_floor: Annotated[
        float,
        key(
            "motor_floor_percent",
            above=0.0,
            help="Smallest standard deviation of the motor's back EMF and lag, however many windows.",
        ),
    ] = 1e-3
    restart_after: Annotated[
        int,
        key(minimum=1, help="Number of windows in a row that must agree on other numbers to replace the learnt ones."),
    ] = 3

    def __post_init__(self) -> None:
        check(self)

    def walk(self, elapsed: float) -> Array:
        """(4,) variances that `elapsed` seconds add."""
        days = max(0.0, elapsed) / _DAY_S
        return np.square([self.k_drift, self.c_drift, 0.0, 0.0]) * days

    @property
    def floor(self) -> Array:
        """(4,) least variances."""
        return np.square([self.k_floor, self.c_floor, self.pitch_floor, self.ratio_floor])


class LearntMachine(Struct, frozen=True):
    """Knowledge of a machine after some windows.

    Attributes
    ----------
    factors, covariance : tuple of 4 and of 16 float
        Logarithms of the factors on the model's k/m, c/m, pitch and mass ratio; row by row.
    time : float
        s, on the twin's clock, of the last window that counted.
    windows : int
        Windows that counted.
    softness : (float, float)
        Of the screw, as of `MachineReading`.
    other : LearntMachine or None
        The last machine that was not this one: a rival whose windows have ended, or the one before this.
    mixed : int
        Windows in a row of one machine that are still missing, since windows of two came by turns.
    alarm : str
        Sentence on a machine that is not what was learnt; empty without one.
    rival : LearntMachine or None
        Numbers of the windows since then that contradict it.
    """

    factors: tuple[float, ...]
    covariance: tuple[float, ...]
    time: float
    windows: int = 1
    alarm: str = ""
    rival: LearntMachine | None = None
    softness: tuple[float, float] = (0.0, 0.0)
    other: LearntMachine | None = None
    mixed: int = 0

    @property
    def disputed(self) -> bool:
        """True while windows contradict it, or come from two machines: no setting may rest on it."""
        return self.rival is not None or self.mixed > 0

    def prior(self, settings: LearningSettings, now: float) -> FactorPrior:
        """Prior of a window at a time, s: the factors, widened by their drift since then."""
        covariance = np.array(self.covariance).reshape(_SIZE, _SIZE)
        widened = covariance.diagonal() + settings.walk(now - self.time)
        covariance.flat[:: _SIZE + 1] = widened + np.maximum(0.0, settings.floor - widened)
        return FactorPrior(np.array(self.factors), covariance, self.softness)

    def surely(self) -> Array:
        """(4,) least sizes of the factors' logarithms, at 95 %."""
        spread = np.sqrt(np.diag(np.array(self.covariance).reshape(_SIZE, _SIZE)))
        return np.abs(self.factors) - NORMAL_95 * spread

    def words(self) -> str:
        """The factors in per cent off the model, with half of their 95 % intervals."""
        parts = zip(
            FACTORS, self.factors, np.sqrt(np.diag(np.array(self.covariance).reshape(_SIZE, _SIZE))), strict=True
        )
        return ", ".join(
            f"{name} {100.0 * math.expm1(f):+.3g} ± {100.0 * NORMAL_95 * std:.2g} %" for name, f, std in parts
        )


def nameplate(settings: LearningSettings, k: float, c: float, m: float) -> FactorPrior:
    """Prior before any window, for half-widths of stiffness, damping and mass within which all values are alike."""
    k_std, c_std, ratio_std = (math.hypot(one, other) / math.sqrt(3.0) for one, other in ((k, m), (c, m), (m, m)))
    return FactorPrior.of_spreads(k_std, c_std, settings.pitch, max(ratio_std, settings.ratio_floor))


def updated(
    before: LearntMachine | None,
    settings: LearningSettings,
    estimate: GapEstimate,
    counts: bool,
    now: float,
    stated: FactorPrior | None = None,
) -> LearntMachine | None:
    """Update what is known of the machine by a window.

    Parameters
    ----------
    before : LearntMachine, optional
        None: no window has counted yet.
    settings : LearningSettings
    estimate : GapEstimate
        With its reading, if it has one.
    counts : bool
        True where the trend accepted the estimate.
    now : float
        s, on the twin's clock.
    stated : FactorPrior, optional
        The nameplate's (`nameplate`): a machine that turns out to lie outside of it is an alarm.
    """
    reading = estimate.machine
    if reading is None or (estimate.ok and not counts):
        return before
    # A window may show the machine's numbers, and the gap not well enough or not at all.
    if estimate.ok or estimate.status in (GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND):
        made = LearntMachine(reading.factors, reading.covariance, now, softness=reading.softness)
        if before is None:
            return replace(made, alarm=_outside(None, made, stated) or _softened((0.0, 0.0), made.softness))
        alarm = _drift(before.prior(settings, now), reading) or _outside(before, made, stated)
        return replace(
            made,
            windows=before.windows + 1,
            alarm=alarm or _softened(before.softness, made.softness),
            other=before.rival or before.other,
            mixed=max(0, before.mixed - estimate.ok),
        )
    return before and _contradicted(before, settings, reading, now)


def _contradicted(
    before: LearntMachine, settings: LearningSettings, reading: MachineReading, now: float
) -> LearntMachine:
    """The learnt machine after a window that only other numbers explain: the alarm, and the rival.

    Numbers that agree with the learnt ones, as those of a window that tells nothing of them, are no other machine's.
    """
    if _distance(before.prior(settings, now), reading) <= _AGREEMENT:
        return before
    rival = LearntMachine(reading.factors, reading.covariance, now, softness=reading.softness)
    if before.rival is not None and _distance(before.rival.prior(settings, now), reading) <= _AGREEMENT:
        rival = replace(rival, windows=before.rival.windows + 1)
    alarm = f"the machine is not the one that was learnt: {rival.words()}, and {before.words()} was learnt"
    # A rival that comes back is no new machine: there are two.
    back = before.other is not None and _distance(before.other.prior(settings, now), reading) <= _AGREEMENT
    mixed = settings.restart_after if back or before.mixed > 0 else 0
    if back:
        alarm = (
            f"windows of two machines come under this name, or of one with two loads: {rival.words()}, and "
            f"{before.words()}; neither is relied on until {mixed} windows in a row are of one of them"
        )
    if rival.windows >= settings.restart_after:
        alarm = f"{alarm}; it is learnt anew from {rival.windows} windows that agree"
        return replace(rival, alarm=alarm, other=replace(before, rival=None, other=None, alarm=""), mixed=mixed)
    return replace(before, alarm=alarm, rival=rival, mixed=mixed)


def _outside(before: LearntMachine | None, after: LearntMachine, stated: FactorPrior | None) -> str:
    """Sentence on a factor that has turned out to be outside of what is stated of it; empty without one."""
    if stated is None:
        return ""
    allowed = math.sqrt(3.0) * np.sqrt(np.diag(stated.covariance))  # half-widths within which all values are alike
    now, then = after.surely(), None if before is None else before.surely()
    for name, off, was, most in zip(FACTORS, now, now if then is None else then, allowed, strict=True):
        if off > most and (then is None or was <= most):
            return (
                f"the machine is not what is stated: {name} is at least {100.0 * off:.3g} % (logarithm) off the model, "
                f"and {100.0 * most:.3g} % are stated; check the nameplate"
            )
    return ""


def _distance(known: FactorPrior, reading: MachineReading) -> float:
    """Distance of a reading from what is known, both uncertain, in standard deviations."""
    away = np.array(reading.factors) - known.mean
    return math.sqrt(
        float(away @ np.linalg.solve(known.covariance + np.array(reading.covariance).reshape(_SIZE, _SIZE), away))
    )


def _softened(before: tuple[float, float], after: tuple[float, float]) -> str:
    """Sentence on a screw that has turned out to be soft with this window; empty where it has not."""
    (was, known), (softness, information) = before, after
    if softness * math.sqrt(information) <= _DRIFT or was * math.sqrt(known) > _DRIFT:
        return ""
    return (
        f"the screw is softer than the model says, by {100.0 * softness:.2g} % of the structure's compliance; "
        "intervals are widened by what that does to the gap"
    )


def _drift(known: FactorPrior, reading: MachineReading) -> str:
    """Sentence on a window whose own reading lies far from what was known; empty where it does not.

    The reading holds the prior, so that its move has the variance by which the prior's shrank.
    """
    moved = np.array(reading.factors) - known.mean
    # In units of the prior's own spreads: those of damping would drown a drift of the stiffness.
    spread = np.sqrt(np.diag(known.covariance))
    shrunk = (known.covariance - np.array(reading.covariance).reshape(_SIZE, _SIZE)) / np.outer(spread, spread)
    values, vectors = np.linalg.eigh(shrunk)
    informative = values > _LEAST_INFORMATION
    if float(np.sum(np.square(vectors[:, informative].T @ (moved / spread)) / values[informative])) <= _DRIFT**2:
        return ""
    index = int(np.argmax(np.abs(moved) / spread))
    change = 100.0 * math.expm1(float(moved[index]))
    return f"the model drifts: {FACTORS[index]} moved by {change:+.2g} % in one window, beyond what is assumed of it"
