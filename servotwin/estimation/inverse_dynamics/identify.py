"""A drive's parameters from recordings: `identify_drive`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics import checks
from servotwin.estimation.inverse_dynamics.closed_loop import FittedLaw, Refinement, refine
from servotwin.estimation.inverse_dynamics.command_delay import (
    NEAR,
    CommandDelay,
    delay_remark,
    derivative,
    fitted_delay,
    later,
)
from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand, band_of, busiest, motion_of
from servotwin.estimation.inverse_dynamics.fit import (
    ASYMMETRIC,
    SYMMETRIC,
    ParameterFit,
    cycle_time,
    fit_models,
    joined,
    rows_of,
    widened,
)
from servotwin.estimation.inverse_dynamics.fitted_cascade import EXPLAINED, RICHER, GivenGains, fitted_cascade
from servotwin.estimation.inverse_dynamics.fitted_pid import GivenPid, fitted_pid
from servotwin.estimation.inverse_dynamics.friction import FrictionForce, friction_forces
from servotwin.estimation.inverse_dynamics.hidden_shaft import HiddenShaft, hidden_shaft
from servotwin.estimation.inverse_dynamics.next_experiment import NextExperiment, next_experiment
from servotwin.estimation.inverse_dynamics.recording import DriveRecording, held_command
from servotwin.estimation.inverse_dynamics.shaft import ShaftResponse, shaft_response, split_inertia
from servotwin.estimation.inverse_dynamics.slip import BeltSlip, belt_slip
from servotwin.estimation.inverse_dynamics.tight_spot import tight_spot
from servotwin.estimation.inverse_dynamics.unmodelled import Unmodelled, effects_of, unmodelled
from servotwin.plant.signals import Array

GivenLaw = GivenGains | GivenPid
# Of the ways of reference and position: a loop that follows is within.
_SAME_WAY = 1.2
_FITTED, _FITTED_PID = GivenGains(), GivenPid()
# Of the force: the PID that ran left a thousandth, one fitted to a cascade's log a fifth.
_PID_LEAVES = 0.05
# With 1 inertias of thinned logs were up to 1.5 half-widths off, with 2 up to 0.9.
_LAW_COUNTS = 2.0
# Of the command. Noise of a record, which the loop had not, left 0.02 to 0.08, and made lags of 0.4 to 4 samples of
# none; late drives left 0.0003.
_THAT_RAN = 0.005
_FIRST_LAG = 0.5  # samples


@dataclass(frozen=True, eq=False)
class IdentifiedDrive:
    """Parameters of a drive.

    Attributes
    ----------
    symmetric, asymmetric : ParameterFit
        By inverse dynamics, of all recordings together.
    bands : tuple of RegressionBand
        One for each recording.
    law : FittedCascade, FittedPid or None
        Of the first recording; None: neither were its gains given, nor does its reference show them.
    refinement : Refinement or None
        By closed-loop simulation of the first recording; None where it is not possible.
    doubts : tuple of str
        Why there is no refinement.
    advice : NextExperiment
    shaft : ShaftResponse or None
        From motor to load, of the first recording; None: it has no load encoder.
    split : ParameterFit or None
        With the inertias before and behind the shaft; None: the recording shows no elasticity.
    late : str
        By how much the command moves the drive at another time than it was logged; empty: it does not for sure.
    elastic : str
        Elasticity that the motor's encoder shows and the axis does not have; empty: none for sure.
    slip : str
        Slip of the load against the motor; empty: no load encoder, or none for sure.
    tight : str
        Part of the travel with more friction, in the first recording; empty: none for sure.
    beside : str
        What the simulated loop leaves of the command, where it is much.
    friction : tuple of FrictionForce
        At the mean and the largest speed of the first recording, by the refinement if it converged.
    """

    symmetric: ParameterFit
    asymmetric: ParameterFit
    bands: tuple[RegressionBand, ...]
    law: FittedLaw | None
    refinement: Refinement | None
    doubts: tuple[str, ...]
    advice: NextExperiment
    shaft: ShaftResponse | None = None
    split: ParameterFit | None = None
    late: str = ""
    elastic: str = ""
    slip: str = ""
    tight: str = ""
    beside: str = ""
    friction: tuple[FrictionForce, ...] = ()


def identify_drive(
    recordings: Sequence[DriveRecording], gains: GivenLaw = _FITTED, p: float = 1.0, applied: bool = False
) -> IdentifiedDrive:
    """Fit inertia, friction and offset, then refine them by simulating the loop.

    Parameters
    ----------
    recordings : sequence of DriveRecording
        Of one drive.
    gains : GivenGains or GivenPid
        Of the controller that ran, a cascade by default.
    p : float
        Travel per radian of the motor.
    applied : bool
        The recorded command is what the drive gave, also at its limit.

    Raises
    ------
    InvalidInput
        A recording does not show the parameters: no motion, one direction or one speed only, a command at its limit, of
        the wrong sign or of something else.
    """
    used, rows, held, motions, bands = [], [], [], [], []
    for each in recordings:
        checks.check_motion(each)
        band = band_of(each)
        motion = motion_of(each.position, each.rate, band)
        if not applied:
            checks.check_limit(each, motion)
            each = checks.without_limit(each)
        checks.check_directions(each, motion)
        used.append(each)
        motions.append(motion)
        bands.append(band)
        rows.append(rows_of(each, motion, band, cycle_time(motion)))
        checks.check_one_drive(each, rows[-1])
        held.append(rows_of(held_command(each), motion, band, cycle_time(motion)))
    every = joined(rows)
    checks.check_separable(used[0], every)
    fits = fit_models(every)
    checks.check_sense(used[0], fits[0])
    law, doubts = _law(used[0], gains)
    loop = _Loop(None if doubts else law, used[0], bands[0], cycle_time(motions[0]), p)
    late = fitted_delay(used, motions, bands)
    found, words = _late(late, loop)
    if not words:
        others = fit_models(joined(held))
        found = loop.refined((widened(fits[0], others[0]), widened(fits[1], others[1])), 0.0)
    # No further motion shows more of what the hold does.
    advice = next_experiment(late.statistical if words else fits[0], every, motions[0], used[0].unit)
    hidden = hidden_shaft(used, motions, bands, late)
    found = found.with_shaft(hidden, late)
    effects = _effects(used, motions, bands, late)
    found = found.with_unmodelled(effects)
    slip = belt_slip(used, motions, bands)
    found = found.with_slip(slip)
    spot = None if slip is not None else tight_spot(used[0], motions[0], bands[0])
    # What slips is neither late nor elastic.
    shaft = None if slip is not None else shaft_response(used[0])
    split = None if shaft is None else split_inertia(used[0], bands[0], shaft)
    return IdentifiedDrive(
        found.symmetric,
        found.asymmetric,
        tuple(bands),
        law,
        found.refinement,
        doubts or found.doubts,
        advice,
        shaft,
        split,
        words,
        "" if hidden is None or slip is not None or split is not None else hidden.remark(used[0].load is not None),
        "" if slip is None else slip.remark(used[0].unit),
        "" if spot is None else spot.remark(used[0].unit),
        "" if slip is not None else found.beside(law),
        found.friction(motions[0].speeds, effects),
    )


def _effects(
    recordings: Sequence[DriveRecording],
    motions: Sequence[DriveMotion],
    bands: Sequence[RegressionBand],
    late: CommandDelay,
) -> Unmodelled | None:
    """Effects beside the parameters and a delay, by the command."""
    every, effects = [], []
    for recording, motion, band in zip(recordings, motions, bands, strict=True):
        part, moved = busiest(later(recording, late.delay), motion)
        effects.append(effects_of(moved, band, part.position, late.symmetric))
        extra = np.column_stack([derivative(part, part.force), effects[-1].columns])
        every.append(rows_of(part, moved, band, cycle_time(motion), extra))
    return unmodelled(joined(every), effects[0])


def stated_law(cascade: GivenGains, pid: GivenPid) -> GivenLaw:
    """The law of which gains are stated; a cascade where none are.

    Raises
    ------
    InvalidInput
        Gains of both are stated.
    """
    if pid != _FITTED_PID and cascade != _FITTED:
        raise InvalidInput(
            "servotwin commission: --kp, --ki, --kd and --derivative-filter are a PID's, and --position-gain, "
            "--velocity-gain, --integral-time and --speed-filter a cascade's: state one of the two"
        )
    return cascade if pid == _FITTED_PID else pid


@dataclass(frozen=True, eq=False)
class _Fits:
    """Both models by inverse dynamics, the refinement, and why there is none."""

    symmetric: ParameterFit
    asymmetric: ParameterFit
    refinement: Refinement | None
    doubts: tuple[str, ...]

    @property
    def lag(self) -> float | None:
        """Of the simulated loop, s; None: there is none that can be taken."""
        return self.refinement.lag if self.refinement is not None and self.refinement.converged else None

    def with_shaft(self, hidden: HiddenShaft | None, late: CommandDelay) -> _Fits:
        """These, their intervals with what a shaft behind the motor's encoder does."""
        if hidden is None:
            return self
        symmetric, asymmetric = hidden.rigid
        refined = self.refinement
        if refined is not None:
            both = widened(refined.symmetric, symmetric), widened(refined.asymmetric, asymmetric)
            refined = replace(refined, symmetric=both[0], asymmetric=both[1])
        if not hidden.sure:  # what it does beside a delay that is not sure either
            symmetric = replace(symmetric, values=self.symmetric.values + symmetric.values - late.symmetric.values)
            asymmetric = replace(asymmetric, values=self.asymmetric.values + asymmetric.values - late.asymmetric.values)
        return _Fits(widened(self.symmetric, symmetric), widened(self.asymmetric, asymmetric), refined, self.doubts)

    def with_unmodelled(self, effects: Unmodelled | None) -> _Fits:
        """These, their intervals with what effects beside the parameters do, in a loop that comes to no rest too."""
        fits = self.symmetric, self.asymmetric
        for each in self._that_count(effects):
            fits = each.widened(fits)
        return replace(self, symmetric=fits[0], asymmetric=fits[1])

    def _that_count(self, effects: Unmodelled | None) -> list[Unmodelled]:
        """Effects by inverse dynamics, and of a loop that comes to no rest.

        What inverse dynamics leaves for no reason is noise, unless the loop does not follow the log either.
        """
        refined = self.refinement
        unrest = None if refined is None or refined.converged else refined.effects
        known = None if effects is None or not (effects.kinds or self.doubts) else effects
        return [each for each in (known, unrest) if each is not None]

    def friction(self, speeds: Array, effects: Unmodelled | None) -> tuple[FrictionForce, ...]:
        """Friction at these speeds."""
        refined = self.refinement
        if refined is not None and refined.converged:
            fit, every = refined.symmetric, [refined.effects] if refined.effects is not None else []
        else:
            fit, every = self.symmetric, self._that_count(effects)
        return friction_forces(fit, speeds, sum((each.friction for each in every), np.zeros_like(speeds)))

    def beside(self, law: FittedLaw | None) -> str:
        """Sentence on effects beside the parameters; empty: none that matters."""
        refined = self.refinement
        if refined is None or not refined.converged or refined.effects is None:
            return ""
        if not refined.effects.kinds and (law is None or law.left > _THAT_RAN):
            return ""
        return refined.effects.remark(refined.symmetric)

    def with_slip(self, slip: BeltSlip | None) -> _Fits:
        """These, their intervals with what slip between motor and load does."""
        if slip is None:
            return self
        symmetric, asymmetric = slip.symmetric.only(SYMMETRIC), slip.asymmetric.only(ASYMMETRIC)
        refined = self.refinement
        if refined is not None:
            both = widened(refined.symmetric, symmetric), widened(refined.asymmetric, asymmetric)
            refined = replace(refined, symmetric=both[0], asymmetric=both[1])
        return _Fits(widened(self.symmetric, symmetric), widened(self.asymmetric, asymmetric), refined, self.doubts)


class _Loop(NamedTuple):
    """The loop that is simulated along a recording; `law` is None where none explains the command."""

    law: FittedLaw | None
    recording: DriveRecording
    band: RegressionBand
    cycle: float
    p: float

    def refined(self, fits: tuple[ParameterFit, ParameterFit], lag: float) -> _Fits:
        """Both models and their refinement, if there is one; a lag (s) is fitted where its first value is not 0."""
        if self.law is None:
            return _Fits(*fits, None, ())
        possible = fits[0]["inertia"] > 0.0
        found = refine(fits[0], self.law, self.recording, self.band, self.cycle, self.p, lag) if possible else None
        if found is None:
            return _Fits(*fits, None, ("the simulated loop does not follow the log",))
        doubts = () if found.converged else ("the fit to the simulated motion did not converge",)
        return _Fits(*fits, _with_its_law(found, fits, self.recording.rate), doubts)


def _late(late: CommandDelay, loop: _Loop) -> tuple[_Fits, str]:
    """The fits with the command at its delay, and the sentence on that; empty: the delay is not evident."""
    fits, rate = (late.symmetric, late.asymmetric), loop.recording.rate
    behind = late.beyond_hold(rate)
    # Reversals hide a delay from inverse dynamics, and not from the simulated loop.
    that_ran = loop.law is not None and loop.law.left < _THAT_RAN
    # A delay that leaves no axis is none.
    if (behind == 0.0 and not that_ran) or not fits[0]["inertia"] > 0.0:
        return _Fits(*fits, None, ()), ""
    found = loop.refined(fits, _FIRST_LAG / rate if behind == 0.0 else max(behind, 0.0))
    return found, delay_remark(late, found.lag if that_ran else None, rate, loop.band.corner)


def _law(recording: DriveRecording, gains: GivenLaw) -> tuple[FittedLaw | None, tuple[str, ...]]:
    """The law that ran or is stated, and why its loop cannot be simulated."""
    if recording.reference is None:
        given = _fitted_law(recording, gains) if gains.complete else None
        return given, ("without a reference the loop cannot be simulated",)
    law = _fitted_law(recording, gains)
    if law.explains:
        return law, ()
    checks.check_reference(recording, gains if isinstance(gains, GivenGains) else _FITTED)
    return (law if gains.complete else None), (_unexplained(law, gains) + _other_way(recording),)


def _with_its_law(found: Refinement, first: tuple[ParameterFit, ParameterFit], rate: float) -> Refinement:
    """The refinement, its intervals with what a law does that is not quite the one that ran.

    Where its law ran at the log's rate the simulated loop leaves a hundredth of what inverse dynamics leaves, or less;
    a tenth to all of it where the log holds every second to tenth sample. The parameters are as uncertain as they
    differ from those of inverse dynamics, by twice that share; by all of it where the drive has a lag, which may be a
    delay as well.
    """
    share = min(1.0, _LAW_COUNTS * found.symmetric.relative_error / first[0].relative_error)
    share = 1.0 if found.lag > NEAR / rate else share
    both = zip((found.symmetric, found.asymmetric), first, strict=True)
    symmetric, asymmetric = (widened(fit, other, share) for fit, other in both)
    return replace(found, symmetric=symmetric, asymmetric=asymmetric)


def _fitted_law(recording: DriveRecording, gains: GivenLaw) -> FittedLaw:
    """The law whose gains are given; else a cascade, or a PID where that explains the command better."""
    if isinstance(gains, GivenPid):
        return fitted_pid(recording, gains)
    cascade = fitted_cascade(recording, gains)
    if gains != _FITTED or cascade.left < EXPLAINED:
        return cascade
    pid = fitted_pid(recording)
    return pid if pid.left < min(RICHER * cascade.left, _PID_LEAVES) else cascade


def _unexplained(law: FittedLaw, gains: GivenLaw) -> str:
    """Say why a law is not the one that ran."""
    if gains != _FITTED and math.isfinite(law.left):
        return (
            f"the controller with the gains that are given leaves {100.0 * law.left:.0f} % of the command: check them "
            "and their units, or leave them out, and they are fitted"
        )
    said = "neither a position controller with velocity loop nor a PID explains the command"
    if math.isfinite(law.left):
        return f"{said} ({100.0 * law.left:.0f} % are left)"
    return (
        f"{said} (its gains would be negative): is the reference late, or in another unit or scale than the position?"
    )


def _other_way(recording: DriveRecording) -> str:
    """Say where the reference moves much further than the position, or much less."""
    assert recording.reference is not None
    moved = float(np.ptp(recording.reference) / np.ptp(recording.position))
    if 1.0 / _SAME_WAY < moved < _SAME_WAY:
        return ""
    return f"; the reference moves {moved:.4g} times as far as the position: have both the same unit?"
