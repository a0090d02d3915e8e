"""The gap between two encoders whose load swings, sticks and winds up: `gap_of_driven_load`."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.core.whitening import burg
from servotwin.estimation.driven_load.fit import SLOWER, LoadFit, best_fit, carried, slowest_and_fastest
from servotwin.estimation.driven_load.flanks import parts_without_pause, reversals_of
from servotwin.estimation.driven_load.problem import ONE_MASS, DrivenLoad, Links, LoadDynamics
from servotwin.estimation.estimate import NORMAL_95, GapStatus
from servotwin.estimation.kinematic.curves import FittedCurves
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.models import ModelTrial
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import counts_of, noise_of, play_and_side
from servotwin.estimation.kinematic.travel import units_of
from servotwin.estimation.kinematic.wind_up import TransmissionGap, travel_of_machine
from servotwin.estimation.output_error.models import DELAY, HALF, OFFSET
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array

_MOST = 10_000  # samples
_LEAST, _ENOUGH = 6, 12  # strokes within them
_DAMPED = 2.0  # of the critical damping: beyond, the load does not swing
_FOLDS = 8  # parts of the recording, whose errors are compared
_EVIDENCE = 2.0  # standard errors
# Of the error of play alone on unseen strokes: a larger one is no evidence for dynamics. Loads that the samples show
# left 0.02 to 8 %; loads that are too fast for them, and rigid ones whose counts the fit smooths, 24 to 40 %.
_BETTER = 0.1
_SEEN = 0.75  # of the samples are fitted; the others are predicted
_OTHERS = (0.8, 1.25)  # gaps over the best one that the recording must rule out
_COUNTS = 0.7  # that a model may leave, white or not; rounding leaves less
_NOISE = 4.0  # of what differs from sample to sample in the recording: a model may leave so much
_WHITE = 0.5  # of the variance of what is left, which its past must not predict
_AT_BOUND = 0.98
_NO_BETTER = "a load on a spring predicts its motion hardly better than play alone"
_WIDEST = 0.3  # of the gap: half an interval
_STEPS = 12
_SETTLED = 5.0  # time constants of the observer


class DrivenGap(NamedTuple):
    """Gap that a model with dynamics finds in a recording.

    Attributes
    ----------
    gap : TransmissionGap or None
        None: the recording does not show it, for the reason given.
    dynamics : LoadDynamics or None
        None: nothing was fitted.
    reason : str
    share : float
        Error of samples that it was not fitted to, over that of play alone; NaN where nothing was fitted.
    """

    gap: TransmissionGap | None
    dynamics: LoadDynamics | None
    reason: str
    share: float = math.nan

    def trial(self) -> ModelTrial:
        """A line for the table of models."""
        found = math.nan if self.gap is None else self.gap.lost.at_motor
        tried = f"{100.0 * self.share:.3g} % of the error of play alone on unseen strokes"
        swings = "" if self.dynamics is None else f", {self.dynamics.frequency / (2.0 * math.pi):.3g} Hz"
        said = "taken: " + tried + swings if self.gap is not None else f"not taken: {self.reason}"
        name = "two masses" if self.dynamics is None else self.dynamics.name
        return ModelTrial(name, found, math.nan, said)


def gap_of_driven_load(recording: EncoderRecording, lost: LostMotion, known: LoadDynamics | None = None) -> DrivenGap:
    """Fit a load behind play and spring to the motor's and the load's motion, and judge if it shows the gap.

    While the load swings freely in the gap, nothing but its friction brakes it; while the transmission winds up, the
    spring drives it. A recording that is fast enough tells one from the other, and the gap from the wind-up by
    friction. The frequency, dampings and friction of the load are fitted with the gap.

    Parameters
    ----------
    recording : EncoderRecording
        Of its longest part without a pause 10 000 samples count: from the first on, or every k-th one where these hold
        fewer than twelve strokes.
    lost : LostMotion
        Its answer without dynamics: ratio, lag and cyclic errors.
    known : LoadDynamics, optional
        Of the machine as far as it is known, in the recording's units: where the search also begins.
    """
    if not math.isfinite(lost.ratio) or lost.ratio == 0.0:
        return DrivenGap(None, None, "the load does not follow the motor")
    piece = _piece(recording, lost)
    strokes = _strokes(piece, lost)
    if strokes < _LEAST:
        return DrivenGap(
            None,
            None,
            f"{strokes} strokes in {piece.time.size} samples without a pause are too few to see how the load moves: "
            "move faster",
        )
    cycles = lost.cycles if "cyclic" in lost.model else ()
    fitted, unseen = _parted(piece)
    strokes = max(round(_SEEN * strokes), 1)
    blank = LoadDynamics(1.0, 1.0, 1.0)
    problem = DrivenLoad(blank, fitted, lost.ratio, 0.0, cycles)
    quasi_static = _quasi_static(problem, lost)
    if known is not None and known.frequency > problem.fastest:
        return DrivenGap(None, known, _too_fast(known.frequency, problem))
    found = best_fit(problem, quasi_static, strokes, known)
    if found is None:
        return DrivenGap(None, None, "too few samples a stroke to see how the load moves: record faster")
    counts = _counts(recording, abs(lost.ratio))
    share = _unseen_share(found, unseen, lost)
    noise = math.hypot(noise_of(recording.motor) * abs(lost.ratio), noise_of(recording.load))
    reason = _doubt(found, quasi_static, counts, noise, strokes)
    if not reason and not share < _BETTER:
        reason = _NO_BETTER
    if reason:
        return DrivenGap(None, found.dynamics, reason, share)
    slower = found.again(_STEPS, rate=SLOWER * found.rate)
    # Friction is never as constant as the model has it: as with a known machine, what it winds up is doubtful.
    half = math.hypot(NORMAL_95 * _std(found, slower, counts), found.lost - found.gap)
    if half > _WIDEST * found.gap:
        reason = f"the gap is known to {100.0 * half / found.gap:.0f} % only with the load's dynamics"
        return DrivenGap(None, found.dynamics, reason, share)
    return DrivenGap(_answer(found, half, lost), found.dynamics, "", share)


def load_of(machine: Plant, load_unit: float) -> LoadDynamics | None:
    """Dynamics of a machine's load; None where nothing between motor and load gives way.

    A chain that is held to the ground is taken for one mass.

    `load_unit` is the recording's unit of the load in SI units.
    """
    if not isinstance(machine, Axis) or math.isinf(machine.transmission.k_d):
        return None
    stiffness, mass = machine.transmission.k_d, float(np.sum(machine.load.masses))
    frequency = math.sqrt(stiffness / mass)
    critical = 2.0 * mass * frequency
    damping, friction = machine.transmission.c_d / critical, machine.guide.friction / stiffness / load_unit
    load = machine.load
    if load.n == 1 or not load.free:
        return LoadDynamics(frequency, damping, friction, float(np.sum(load.dampings)) / critical)
    links = Links(
        tuple((load.masses / mass).tolist()),
        tuple((load.stiffnesses[1:] / stiffness).tolist()),
        tuple((load.dampings[1:] / critical).tolist()),
    )
    return LoadDynamics(frequency, damping, friction, load.c[0] / critical, links)


def swings(found: TransmissionGap) -> bool:
    """True where play alone leaves so much of the load's motion that not even the lost motion is known."""
    return found.status is GapStatus.MODEL_MISMATCH


def with_dynamics(recording: EncoderRecording, found: TransmissionGap, machine: Plant | None = None) -> TransmissionGap:
    """The gap that the load's dynamics show where the motion alone does not; else what is known, and the reason.

    With a `machine` the search also begins at its load. One whose load is a chain is tried with one mass first.
    """
    if found.ok or found.status is GapStatus.LOWER_BOUND:
        return found
    known = None if machine is None else load_of(machine, units_of(recording, travel_of_machine(machine))[1])
    single = known if known is None else replace(known, links=ONE_MASS)
    driven = gap_of_driven_load(recording, found.lost, single)
    if driven.gap is None and known is not None and len(known.links.masses) > 1:
        driven = gap_of_driven_load(recording, found.lost, known)
    if driven.gap is not None:
        return replace(driven.gap, dynamics=driven.trial())
    *others, last = found.reasons or ("",)
    reasons = (*others, f"the load's dynamics do not show the gap: {driven.reason}", last)
    return replace(found, reasons=tuple(reason for reason in reasons if reason), dynamics=driven.trial())


def _piece(recording: EncoderRecording, lost: LostMotion) -> EncoderRecording:
    """At most 10 000 samples of the longest part without a pause; nothing says how the load moved in one."""
    rows = max(parts_without_pause(recording), key=len)
    whole = _rows(recording, rows)
    if rows.size > _MOST:
        # Strokes that last longer than the samples go are worth more than every sample of few strokes.
        wanted = _ENOUGH * rows.size / (max(_strokes(whole, lost), 1) * _MOST)
        every = min(max(1, math.ceil(wanted)), math.ceil(rows.size / _MOST))
        whole = _rows(recording, rows[::every][:_MOST])
    return whole


def _rows(recording: EncoderRecording, rows: NDArray[np.int_]) -> EncoderRecording:
    return replace(recording, time=recording.time[rows], motor=recording.motor[rows], load=recording.load[rows])


def _parted(piece: EncoderRecording) -> tuple[EncoderRecording, EncoderRecording]:
    """The samples that are fitted, and those that are predicted."""
    place = round(_SEEN * piece.time.size)
    rows = np.arange(piece.time.size)
    return _rows(piece, rows[:place]), _rows(piece, rows[place:])


def _unseen_share(found: LoadFit, recording: EncoderRecording, lost: LostMotion) -> float:
    """Error of the motion that a fit predicts in samples that it has not seen, over that of play alone."""
    problem = replace(found.problem, dynamics=found.dynamics, recording=recording)
    values = carried(found, problem, found.gap)
    states = -2 * problem.model.axis.n
    values[states:] = problem.start(0.0, 0.0)[states:]
    settled = min(round(_SETTLED / (found.rate * problem.interval)), problem.position.size // 2)
    left = problem.misfit(values, found.rate)[settled:]
    bare = problem.quasi_static_misfit(_quasi_static(problem, lost), found.rate)[settled:]
    return float(np.std(left) / max(float(np.std(bare)), np.finfo(float).tiny))


def _strokes(piece: EncoderRecording, lost: LostMotion) -> int:
    first, last = piece.time[0], piece.time[-1]
    if lost.local:
        return sum(first <= each.time <= last for each in lost.local)
    return reversals_of(piece.motor) + 1


def _quasi_static(problem: DrivenLoad, lost: LostMotion) -> Array:
    """(N,) load that the model without dynamics predicts."""
    gap = lost.at_load if math.isfinite(lost.at_load) else 0.0
    place = play_and_side(problem.drive, gap, np.zeros(problem.drive.size, dtype=np.int8))
    late = np.interp(np.arange(place.size) - lost.lag / problem.interval, np.arange(place.size), place)
    return np.asarray(late - np.mean(late - problem.position))


def _doubt(found: LoadFit, quasi_static: Array, counts: float, noise: float, strokes: int) -> str:
    """Reason not to believe the fit; empty: none. `counts` is one of both encoders, at the load, as `noise` is."""
    problem = found.problem
    bare = problem.quasi_static_misfit(quasi_static, found.rate)
    if not found.rms < _BETTER * float(np.std(bare)) or not _worse(bare, found.fit.raw):
        return _NO_BETTER
    slowest, fastest = slowest_and_fastest(problem, strokes)
    if found.dynamics.frequency > fastest:
        return _too_fast(found.dynamics.frequency, problem)
    limits = problem.limits()
    bound = [
        unknown.name
        for unknown, value, limit in zip(problem.model.unknowns, found.fit.values, limits, strict=True)
        if math.isfinite(limit) and (value if unknown.unit == "damping" else abs(value)) > _AT_BOUND * limit
    ]
    # The fit begins again at what it found, which its bounds move along with.
    dynamics = found.dynamics
    bound += ["frequency"] if dynamics.frequency < slowest else []
    bound += ["damping"] if max(dynamics.damping, dynamics.viscous) > _DAMPED else []
    if bound:
        return f"the fit of the load's dynamics ends at a bound ({', '.join(bound)})"
    # Impacts of a wrong model, far apart, may look white: they are larger than what differs from sample to sample.
    coloured = burg(found.fit.raw[None], 24).unpredicted < _WHITE
    if found.rms > _COUNTS * counts and (coloured or found.rms > _NOISE * noise):
        return "the load on a spring leaves more than noise: it has other dynamics too"
    for other in _OTHERS:
        tried = found.split(other * found.gap, _STEPS, gap_free=False)
        if not _worse(tried.fit.raw, found.fit.raw):
            return (
                f"gap and wind-up by friction look alike here, also with the load's dynamics: {100.0 * other:.0f} % of "
                "the gap explain the recording as well; record faster reversals too"
            )
    return ""


def _too_fast(frequency: float, problem: DrivenLoad) -> str:
    rate = frequency / problem.fastest / problem.interval
    return f"the load swings too fast for the recording: record at {rate:.2g} Hz or more"


def _worse(raw: Array, best: Array) -> bool:
    """True where errors are larger than the best ones, by more than their ratio differs between parts."""
    raws, bests = (
        np.array([np.mean(part**2) for part in np.array_split(each, _FOLDS)]) + np.finfo(float).tiny
        for each in (raw, best)
    )
    gain = np.log(raws / bests)
    return bool(gain.mean() > _EVIDENCE * gain.std(ddof=1) / math.sqrt(_FOLDS))


def _std(found: LoadFit, slower: LoadFit, counts: float) -> float:
    """Standard deviation of the gap at the load.

    Errors of neighbouring samples may be alike: parts of the recording show by how much more they change the gap than
    as many independent ones. What another observer finds counts as one standard deviation, and counts of the
    encoders, which are the same at every reversal, as what they are.
    """
    rows, residual = found.fit.rows[:, : found.fit.raw.size], found.fit.residual[: found.fit.raw.size]
    free = np.flatnonzero(found.problem.free & (np.linalg.norm(rows, axis=1) > 0.0))
    scaled = rows[free] / np.linalg.norm(rows[free], axis=1)[:, None]
    inverse = np.linalg.pinv(scaled @ scaled.T, rcond=1e-12)
    slopes = np.array(
        [
            part @ left
            for part, left in zip(np.array_split(scaled, _FOLDS, axis=1), np.array_split(residual, _FOLDS), strict=True)
        ]
    )
    at = int(np.flatnonzero(free == HALF)[0])
    of_parts = inverse[at] @ (slopes.T @ slopes) @ inverse[at] * _FOLDS / (_FOLDS - 1.0)
    single = max(float(of_parts), float(inverse[at, at]))
    statistical = 2.0 * found.scale * math.sqrt(single) / float(np.linalg.norm(rows[HALF]))
    return math.hypot(statistical, slower.gap - found.gap, counts / math.sqrt(12.0))


def _curves(found: LoadFit, ratio: float) -> FittedCurves:
    """Residual of the next samples, and the motor's lead; no costs, as other gaps were tried at two places only."""
    problem, none = found.problem, np.empty(0)
    driven = found.scale * problem.drive + float(found.fit.values[OFFSET])
    time = problem.recording.time[0] + problem.interval * np.arange(driven.size)
    return FittedCurves(time, problem.position, (driven - problem.position) / ratio, found.fit.raw, none, none)


def _counts(recording: EncoderRecording, ratio: float) -> float:
    motor, load = counts_of(recording)
    return math.hypot(motor * ratio, load)


def _answer(found: LoadFit, half: float, lost: LostMotion) -> TransmissionGap:
    ratio = lost.ratio * found.scale
    at_motor, total, half, std = (each / abs(ratio) for each in (found.gap, found.lost, half, half / NORMAL_95))
    wound = total - at_motor
    dynamics = found.dynamics
    frequency = dynamics.frequency / (2.0 * math.pi)
    reason = (
        f"the load swings at {frequency:.4g} Hz; {wound:.3g} of the lost motion of {total:.4g}, at the motor, are "
        "wind-up by its friction, which its dynamics tell from the gap"
    )
    shown = replace(
        lost,
        at_motor=total,
        std_motor=std,
        interval_motor=(max(total - half, 0.0), total + half),
        ratio=ratio,
        lag=float(found.fit.values[DELAY]),
        status=GapStatus.OK,
        reasons=(),
        model=found.dynamics.name,
        rms=found.rms,
        local=(),
        curves=_curves(found, ratio),
    )
    interval = (max(at_motor - half, 0.0), at_motor + half)
    return TransmissionGap(shown, at_motor, std, interval, GapStatus.OK, (reason,))
