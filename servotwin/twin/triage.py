"""Triage of windows: all get a glance, and only those that may say something new are estimated. An optional part, pure.

A glance takes the plain fit next to the gap that was estimated last, and compares. Nothing moved only where that was
possible to see: a window that does not show the gap, a fit that does not converge, and anything unusual is estimated,
and the reason stored. After every estimate the glance at the same window is compared with it: a servo on which glances
mislead gets none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from msgspec import Struct
from msgspec.structs import replace

from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import quick_bias
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.estimation.whitened.quick import QuickFit, quick_fit
from servotwin.estimation.window import Window
from servotwin.messages import WindowMessage
from servotwin.plant.servo import Servo
from servotwin.twin.estimating import Expectation
from servotwin.twin.settings import TriageSettings

ROUTINE = ("reference", "periodic")
"""Reasons of windows that come anyway; any other says that something is new, or was asked for."""

_SHORTEST = 400  # samples, as for the estimator
_FADES = 0.95  # of the usual misfit, per window: steps to one side may leave more than those to the other
_PATIENCE, _SPARSE = 3, 8  # estimates in a row that did not count, after which only one window in so many is tried


class TriageState(Struct, frozen=True):
    """Slice of the twin's state: the window that was estimated last, with which glances are compared.

    Attributes
    ----------
    doubt : str
        Why no glance is enough; empty: the last window that was estimated may be relied on.
    boot, version : str, int
        Of the window that was estimated last, and of the parameters in force in it.
    time : float
        Of its middle, s.
    gap, std : float
        rad, as estimated.
    bias, bias_std : float
        V; NaN and inf where it did not rest.
    misfit : float
        m, usual.
    glances : int
        Windows since.
    vain : int
        Estimates in a row that did not count.
    """

    doubt: str = "no window was estimated yet"
    boot: str = ""
    version: int = 0
    time: float = 0.0
    gap: float = math.nan
    std: float = math.inf
    bias: float = math.nan
    bias_std: float = math.inf
    misfit: float = math.nan
    glances: int = 0
    vain: int = 0

    def doubted(self, why: str) -> TriageState:
        """With a reason for which the next window is estimated, whatever it shows."""
        return replace(self, doubt=why, glances=0, vain=0)

    def glanced(self, found: Glance) -> TriageState:
        """After a window of which a glance was enough."""
        usual = self.misfit if math.isnan(found.misfit) else max(_FADES * self.misfit, found.misfit)
        return replace(self, misfit=usual, glances=self.glances + 1)


class Glance(Struct, frozen=True):
    """Result of a glance.

    Attributes
    ----------
    gap, std : float
        rad; NaN and inf where it saw none.
    misfit : float
        m.
    bias, bias_std : float
        V; NaN and inf where nothing rests.
    moved : bool
        True where the window is to be estimated.
    why : str
        The reason, in words; where it is not, what was found.
    """

    gap: float
    std: float
    misfit: float
    bias: float
    bias_std: float
    moved: bool
    why: str


def due(message: WindowMessage, state: TriageState, settings: TriageSettings) -> str:
    """Reason to estimate a window whatever it shows; empty: a glance may be enough."""
    if state.doubt:
        return state.doubt
    if message.boot != state.boot:
        return "the edge has started anew"
    if message.reason not in ROUTINE:
        return f"the edge sent it because of: {message.reason or 'nothing stated'}"
    if state.glances + 1 >= settings.every:
        return f"due: {state.glances} windows since the last estimate"
    if abs(message.middle - state.time) >= settings.longest:
        return f"due: {abs(message.middle - state.time):.6g} s since the last estimate"
    return ""


def in_vain(message: WindowMessage, state: TriageState) -> str:
    """Reason to skip a window without a glance: estimates of such windows have not counted lately; empty: none.

    A loop that always shows one contact, of an encoder whose offset is not known, would be estimated for ever.
    """
    changed = (message.boot, message.parameter_version) != (state.boot, state.version) or message.reason not in ROUTINE
    if changed or state.vain < _PATIENCE or state.glances + 1 >= _SPARSE:
        return ""
    return f"not looked at: {state.vain} estimates in a row did not count, and one window in {_SPARSE} is tried"


def glance(
    message: WindowMessage,
    window: Window,
    servo: Servo,
    state: TriageState,
    offset: tuple[float, float] | None = None,
    settings: TriageSettings | None = None,
) -> Glance:
    """Glance at a window: does it have to be estimated?

    Parameters
    ----------
    message : messages.WindowMessage
        For its boot, version and reason.
    window : Window
        The same, decoded.
    servo : Servo
    state : TriageState
    offset : (float, float), optional
        The encoder's offset as earlier windows showed it, mean and standard deviation, rad.
    settings : TriageSettings, optional
    """
    settings, tired = settings or TriageSettings(), in_vain(message, state)
    if tired:
        return _blind(tired, moved=False)
    if window.theta_m is None or window.position.size < _SHORTEST:
        return _blind("the window has no theta_m, or too few samples: what to make of it, the estimator says")
    if not (math.isfinite(state.gap) and float(window.theta_m.max() - window.theta_m.min()) > 0.0):
        return _blind(state.doubt or "the motor's angle is constant")
    fit = quick_fit(window, servo, state.gap, offset)
    bias, bias_std = quick_bias(window, servo)
    found = Glance(fit.gap, fit.std, fit.misfit, bias, bias_std, True, "")
    why = due(message, state, settings) or _unclear(fit, settings) or _moved(found, state, settings)
    return replace(found, moved=bool(why), why=why or "nothing moved")


def _blind(why: str, moved: bool = True) -> Glance:
    return Glance(math.nan, math.inf, math.nan, math.nan, math.inf, moved, why)


def _unclear(fit: QuickFit, settings: TriageSettings) -> str:
    """Reason why a glance cannot decide whether the gap moved; empty: none."""
    if not fit.converged:
        return "the plain fit did not converge"
    if not fit.std <= settings.widest:
        return f"at a glance the window shows the gap to {math.degrees(fit.std):.3g} deg only"
    return ""


def _moved(found: Glance, state: TriageState, settings: TriageSettings) -> str:
    """Change since the last estimate, in words; empty: none."""
    off = abs(found.gap - state.gap)
    if not off <= allowed(math.hypot(found.std, state.std), settings):
        now, before = math.degrees(found.gap), math.degrees(state.gap)
        return f"the gap moved: {now:.4g} deg at a glance, {before:.4g} deg estimated before"
    if not found.misfit <= settings.misfit * max(state.misfit, settings.least_misfit):
        return f"{1e6 * found.misfit:.3g} um are left over, and {1e6 * state.misfit:.3g} um are usual"
    spread = settings.deviations * math.hypot(found.bias_std, state.bias_std)
    if abs(found.bias - state.bias) > max(settings.bias, spread):
        return f"the input bias moved: {found.bias:.4g} V, {state.bias:.4g} V before"
    return ""


def allowed(std: float, settings: TriageSettings) -> float:
    """rad by which gaps may differ that are one, for a spread (rad) of their difference."""
    return max(settings.gap, settings.deviations * std)


@dataclass(frozen=True)
class Triage:
    """The triage of one servo's windows.

    Parameters
    ----------
    servo : Servo
    settings : TriageSettings
    """

    servo: Servo
    settings: TriageSettings

    def glance(
        self, state: TriageState, message: WindowMessage, window: Window, trend: Trend | None, requested: bool
    ) -> tuple[TriageState, Glance | None]:
        """Glance at a window; None where that is not possible, and the estimator says why.

        Parameters
        ----------
        state : TriageState
        message, window
            The window, and the same decoded.
        trend : Trend or None
            As it was left by the windows that counted.
        requested : bool
            True while the edge is asked for a more informative window: all are estimated then.
        """
        compared = replace(state, doubt="a request is open", vain=0) if requested else state
        try:
            found = glance(message, window, self.servo, compared, _offset(trend), self.settings)
        except InvalidInput:
            return state, None
        return (state if found.moved else state.glanced(found)), found

    def estimated(
        self,
        state: TriageState,
        message: WindowMessage,
        window: Window | None,
        estimate: GapEstimate,
        trend: Trend | None,
        rejection: str,
    ) -> TriageState:
        """The state after an estimate; one that was rejected, and why, makes the next window estimated too.

        The glance at the estimate's own window is what later ones are compared with.
        """
        if rejection or window is None:
            boot, version = message.boot, message.parameter_version
            return replace(state, doubt=rejection, glances=0, vain=state.vain + 1, boot=boot, version=version)
        found = quick_fit(window, self.servo, estimate.gap, _offset(trend))
        bias, bias_std = quick_bias(window, self.servo)
        return TriageState(
            doubt=self._misled(found, estimate),
            boot=message.boot,
            version=message.parameter_version,
            time=estimate.time,
            gap=estimate.gap,
            std=estimate.std,
            bias=bias,
            bias_std=bias_std,
            misfit=found.misfit if math.isnan(state.misfit) else max(_FADES * state.misfit, found.misfit),
        )

    def _misled(self, found: QuickFit, estimate: GapEstimate) -> str:
        """The error of a glance, in words; empty where it is small enough."""
        off = abs(found.gap - estimate.gap)
        if off <= allowed(math.hypot(found.std, estimate.std), self.settings):
            return ""
        return f"a glance misled by {math.degrees(off):.3g} deg at the window that was estimated last"


def _offset(trend: Trend | None) -> tuple[float, float] | None:
    return Expectation(0.0, trend).offset
