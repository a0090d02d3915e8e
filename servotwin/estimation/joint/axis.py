"""The joint estimate of an axis that no servo stands for: the output-error fit with wide spreads.

That fit frees the axis's numbers within what is known of them. Here hardly anything is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus, MachineReading
from servotwin.estimation.joint.axis_numbers import adapted, own_number
from servotwin.estimation.joint.verdict import METHOD, JointEstimate, Parameter
from servotwin.estimation.output_error.estimator import FittedWindow, fitted
from servotwin.estimation.output_error.fit import Search, only_rounding
from servotwin.estimation.output_error.held_chain import follows
from servotwin.estimation.output_error.models import HALF, LEARNT, Unknown
from servotwin.estimation.output_error.possible import INDEPENDENT
from servotwin.estimation.output_error.rounding import rounded
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.output_error.taught import moved_by_growth
from servotwin.estimation.output_error.unexplained import left_open, slow_error
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.signals import Array

WIDE = OutputErrorSettings(stiffness=0.2, damping=1.0, mass_ratio=0.1, ratio=0.02, friction=0.5)
"""Spreads of a joint estimate: a stiffness may be off by two thirds, a ratio by 7 %, a damping by any factor."""

_DOUBT = 2.0  # the noise's spectrum and the contacts come from the same window: tails are longer than normal
# Standard deviations of what the model leaves out, of logarithms by the unknown's unit: no window tells a stiffness, a
# friction or a damping better.
_UNMODELLED = {"factor": 1e-2, "damping": 2e-2}
_COUNTS, _LATE = 0.5, 0.1  # the same of the travel that shows the ratio, in counts, and of a delay, in samples
_PRIOR = 0.9  # of what was known: where no less is left, the window tells nothing


@dataclass(frozen=True, eq=False)
class AxisFit:
    """A window's fit, with what was known of the machine before.

    Attributes
    ----------
    axis : Axis
        As stated.
    fit : FittedWindow
    known : FactorPrior, optional
        None: of this kind of axis windows tell each other nothing.
    settings : OutputErrorSettings
    others : bool
        True where what was known is of another window.
    """

    axis: Axis
    fit: FittedWindow
    known: FactorPrior | None
    settings: OutputErrorSettings
    others: bool = False

    @cached_property
    def gap(self) -> GapEstimate:
        """The window's estimate; the model is the axis as stated."""
        found = self.fit.estimate
        reasons = found.reasons
        if self.others and found.status is GapStatus.MODEL_MISMATCH:
            reasons = tuple(f"fitted with what another window tells of the machine, {reason}" for reason in reasons)
        return replace(found, method=METHOD, model_version=self.axis.version, machine=None, reasons=reasons)

    @property
    def reading(self) -> MachineReading | None:
        """The machine's numbers as the window tells them; None: it does not."""
        return self.fit.estimate.machine

    @cached_property
    def places(self) -> dict[str, int]:
        """Of the unknowns that are the machine's, or the encoders' delays: names and places in the fit."""
        if self.fit.search is None:
            return {}
        unknowns = enumerate(self.fit.search.problem.model.unknowns)
        return {unknown.name: place for place, unknown in unknowns if math.isfinite(unknown.std)}

    def unknown(self, name: str) -> Unknown:
        """An unknown of the fit."""
        assert self.fit.search is not None
        return self.fit.search.problem.model.unknowns[self.places[name]]

    @cached_property
    def values(self) -> dict[str, float]:
        """Fitted numbers: logarithms over the stated axis's, or s."""
        search, possible = self.fit.search, self.fit.possible
        if search is None:
            return {}
        likely = search.best.values if possible is None else possible.unknowns
        before = self._before()
        found = {name: before.get(name, 0.0) + float(likely[place]) for name, place in self.places.items()}
        if self.reading is not None and possible is None:
            found.update((name, self.reading.factors[at]) for name, at in LEARNT.items() if name in found)
        return found

    def _before(self) -> dict[str, float]:
        """Logarithms of the numbers at which the fit began, over the stated axis's."""
        if self.known is None:
            return {}
        if follows(self.axis):
            return {"ratio": self.known.pitch[0]}
        return {name: float(self.known.mean[at]) for name, at in LEARNT.items()}

    @cached_property
    def stds(self) -> dict[str, float]:
        """Standard deviations of `values`."""
        search, possible = self.fit.search, self.fit.possible
        if search is None:
            return {}
        scale, known = self.settings.calibration, {name: self.unknown(name).std for name in self.places}
        computed = zip(self.places, _spreads(search, self.places), strict=True)
        found = {name: math.hypot(scale * std, self._unmodelled(name)) for name, std in computed}
        if only_rounding(search.problem, search.best):
            # However many samples there are, they hold a few independent errors.
            fewer = math.sqrt(max(1.0, search.best.raw.size / INDEPENDENT))
            found = {name: min(fewer * std, known[name]) for name, std in found.items()}
        if possible is not None:
            found["ratio"] = scale * math.hypot(possible.ratio_std, moved_by_growth(search))
        elif self.reading is not None:
            spreads = np.sqrt(np.array(self.reading.covariance).reshape(4, 4).diagonal()).tolist()
            found.update((name, spreads[at]) for name, at in LEARNT.items() if name in found)
        return found

    def _unmodelled(self, name: str) -> float:
        """Standard deviation of a number by what does not average out."""
        assert self.fit.search is not None
        problem, unit = self.fit.search.problem, self.unknown(name).unit
        if name == "ratio":
            return _COUNTS * problem.count / float(np.ptp(problem.position))
        return _LATE * problem.interval if unit == "time" else _UNMODELLED[unit]

    def parameters(self) -> dict[str, Parameter]:
        """The fitted numbers in their own units."""
        return {name: self._parameter(name, value) for name, value in self.values.items()}

    def _parameter(self, name: str, value: float) -> Parameter:
        std = self.stds[name]
        if self.unknown(name).unit == "time":
            return Parameter(value, std)
        factor = math.exp(value)
        own = factor * own_number(self.axis, name)
        return Parameter(own, abs(own) * std, factor)

    def covariance(self) -> Array:
        """(1 + P, 1 + P) of total gap (rad) and `values`: the stated deviations, correlated as in the fit."""
        search = self.fit.search
        stds = np.array([self.gap.std, *self.stds.values()])
        if search is None:
            return np.array([[math.inf]])
        places = [HALF, *self.places.values()]
        rows = search.best.rows
        size = np.linalg.norm(rows, axis=1)
        size[size == 0.0] = 1.0
        scaled = rows / size[:, None]
        inverse = np.linalg.pinv(scaled @ scaled.T, rcond=1e-12, hermitian=True)[np.ix_(places, places)]
        length = np.sqrt(np.diag(inverse))
        length[length == 0.0] = 1.0
        correlations = inverse / np.outer(length, length)
        np.fill_diagonal(correlations, 1.0)
        with np.errstate(invalid="ignore"):
            # Nothing is known of a gap that was refused: inf, and no correlation.
            spread = np.outer(stds, stds) * correlations
        return np.where(np.isfinite(spread) | np.eye(stds.size, dtype=bool), spread, 0.0)

    def remarks(self) -> tuple[str, ...]:
        """Name the numbers about which the window says hardly anything."""
        return tuple(
            f"{name} rests on what was known before: the window alone does not show it"
            for name, std in self.stds.items()
            if not std < _PRIOR * self.unknown(name).std and self.unknown(name).unit != "time"
        )


def _spreads(search: Search, places: dict[str, int]) -> list[float]:
    """Standard deviations of unknowns: by noise, by the encoders' rounding, and by slow motion that the fit leaves."""
    chosen, error = list(places.values()), slow_error(search)
    slow = left_open(search, error, chosen) if error > 0.0 else [0.0] * len(chosen)
    noise = [_DOUBT * search.best.std(place, search.free) for place in chosen]
    return [
        math.hypot(one, rounded(search, place), other) for one, place, other in zip(noise, chosen, slow, strict=True)
    ]


def estimate_axis(
    windows: Sequence[Window], axis: Axis, prior: float | GapEstimate | None, settings: OutputErrorSettings
) -> JointEstimate:
    """Fit windows of an axis; each with what that of the others tells of the machine that knows it best.

    Raises
    ------
    InvalidInput
        A window without theta_m, or too short; several windows of a load with friction that the gap holds.
    """
    known = _hardly_known(axis, settings)
    if known is None and len(windows) > 1:
        raise InvalidInput(
            f"{len(windows)} windows of a load that the gap holds, before friction or nothing but an elastic screw: "
            "the joint estimator fits one window of such an axis at a time, because what friction hides is alike in all"
        )
    fits = [
        AxisFit(axis, fitted(window, axis, None if place else prior, settings, known), known, settings)
        for place, window in enumerate(windows)
    ]
    fits = [_with_others(fits, place, window) for place, window in enumerate(windows)]
    counted = [fit for fit in fits if fit.gap.ok]
    leading = (counted or fits)[-1]
    return JointEstimate(
        tuple(fit.gap for fit in fits),
        leading.parameters(),
        ("gap", *leading.values),
        leading.covariance(),
        adapted(axis, leading.values),
        leading.remarks(),
    )


def _hardly_known(axis: Axis, settings: OutputErrorSettings) -> FactorPrior | None:
    """Prior of the machine with the settings' spreads; None of an axis whose windows tell each other nothing."""
    if axis.backlash_kind is not BacklashKind.FREE and not follows(axis):
        return None
    return FactorPrior.of_spreads(settings.stiffness, settings.damping, settings.ratio, settings.mass_ratio)


def _with_others(fits: Sequence[AxisFit], place: int, window: Window) -> AxisFit:
    """The window fitted with the machine as the best of the others tells it; as it was where none does."""
    own, others = fits[place], [fit.reading for fit in fits if fit is not fits[place]]
    readings = [FactorPrior.of_reading(reading) for reading in others if reading is not None]
    if not readings or own.fit.search is None:
        return own
    # Windows alike tell no more than one of them: what the model leaves out does not average.
    best = min(readings, key=lambda reading: float(np.linalg.slogdet(reading.covariance)[1]))
    again = fitted(window, own.axis, own.gap if own.gap.ok else None, own.settings, best)
    return AxisFit(own.axis, again, best, own.settings, others=True)
