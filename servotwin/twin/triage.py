"""Triage of windows: all get a glance, and only informative ones a full estimate. An optional part, pure.

A glance is a quick fit beside the window estimated last; the two gaps are compared. A window is estimated, and the
reason stored, where the gap is not identifiable from it, the fit does not converge, or anything is unusual. After every
estimate the glance at the same window is compared with it: where glances mislead, every window is estimated.
A glance stands on the machine as learnt, where one was; what is still open of its numbers is no news.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from msgspec import Struct
from msgspec.structs import replace

from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import quick_bias
from servotwin.estimation.estimate import GapEstimate, MachineReading
from servotwin.estimation.late_window import prompt_window
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.whitened.quick import NO_SPREAD, MachineSpread, QuickFit
from servotwin.estimation.window import Window
from servotwin.messages import WindowMessage
from servotwin.plant.plants import Plant
from servotwin.twin.quick_fits import Known, QuickFits, quick_fits_of
from servotwin.twin.settings import TriageSettings

ROUTINE = ("reference", "periodic")
"""Reasons of routine windows; any other reason means a change, or a request of the twin."""

_SHORTEST = 400  # samples, as for the estimator
# Factor per window on the usual misfit. It fades slowly, because steps to one side may leave a larger misfit than those
# to the other.
_FADES = 0.95
# Rejected estimates in a row, after which one window in _SPARSE is tried. That is odd: steps to and fro show one flank
# and the other by turns, and two of these show the gap together.
_PATIENCE, _SPARSE = 3, 7


class TriageState(Struct, frozen=True):
    """Part of the twin's state that belongs to triage: the window estimated last, with which glances are compared.

    Attributes
    ----------
    doubt : str
        Reason for which no glance is enough; empty: the last estimate is reliable.
    boot, version : str, int
        Of the window that was estimated last, and of the parameters in force in it.
    time : float
        Of its middle, s.
    gap, std : float
        rad, as estimated.
    model_std : float
        rad, what the estimate adds to its standard deviation for errors of the model.
    bias, bias_std : float
        V; NaN and inf where the loop did not rest.
    misfit : float
        m, usual.
    glances : int
        Windows since.
    vain : int
        Estimates in a row that did not count.
    unknowns : tuple of float
        What the quick fit of the window estimated last had beside the gap, where its kind needs that.
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
    model_std: float = 0.0
    unknowns: tuple[float, ...] = ()

    def doubted(self, why: str) -> TriageState:
        """Copy with a reason for which the next window is estimated in any case."""
        return replace(self, doubt=why, glances=0, vain=0)

    def glanced(self, result: Glance) -> TriageState:
        """Copy after a window for which a glance was enough."""
        usual = self.misfit if math.isnan(result.misfit) else max(_FADES * self.misfit, result.misfit)
        return replace(self, misfit=usual, glances=self.glances + 1)


class Glance(Struct, frozen=True, omit_defaults=True):
    """Result of a glance.

    Attributes
    ----------
    gap, std, std_total : float
        rad; NaN and inf where it has no result. The total contains the model's errors, as those of the last estimate.
    misfit : float
        m.
    bias, bias_std : float
        V; NaN and inf where the loop does not rest.
    moved : bool
        True where the window is to be estimated.
    why : str
        The reason for that decision, in words.
    machine : MachineReading, optional
        The machine's numbers that it stands on; None: the model's.
    """

    gap: float
    std: float
    misfit: float
    bias: float
    bias_std: float
    moved: bool
    why: str
    machine: MachineReading | None = None
    std_total: float = math.inf


def due(message: WindowMessage, state: TriageState, settings: TriageSettings) -> str:
    """Reason to estimate a window in any case; empty: a glance may be enough."""
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


def reason_to_skip(message: WindowMessage, state: TriageState) -> str:
    """Reason to skip a window without a glance: the last estimates of such windows were not accepted; empty: none.

    Otherwise every window would be estimated of a loop that shows one contact only, with the encoder's offset unknown.
    """
    changed = (message.boot, message.parameter_version) != (state.boot, state.version) or message.reason not in ROUTINE
    if changed or state.vain < _PATIENCE or state.glances + 1 >= _SPARSE:
        return ""
    return f"not looked at: {state.vain} estimates in a row did not count, and one window in {_SPARSE} is tried"


def glance(
    message: WindowMessage,
    window: Window,
    servo: Plant,
    state: TriageState,
    offset: tuple[float, float] | None = None,
    settings: TriageSettings | None = None,
    machine: FactorPrior | None = None,
) -> Glance:
    """Glance at a window, and decide if it must be estimated.

    Parameters
    ----------
    message : messages.WindowMessage
        Gives boot, version and reason.
    window : Window
        The window of the message, decoded.
    servo : Servo or Axis
    state : TriageState
    offset : (float, float), optional
        The encoder's offset from earlier windows, mean and standard deviation, rad.
    settings : TriageSettings, optional
    machine : FactorPrior, optional
        The machine's numbers over the servo's, as learnt; None: the servo is exact.
    """
    settings, skipped = settings or TriageSettings(), reason_to_skip(message, state)
    if skipped:
        return _without_result(skipped, moved=False)
    if window.theta_m is None or window.position.size < _SHORTEST:
        return _without_result("the window has no theta_m, or too few samples: the estimator decides")
    if not (math.isfinite(state.gap) and float(window.theta_m.max() - window.theta_m.min()) > 0.0):
        return _without_result(state.doubt or "the motor's angle is constant")
    fit = quick_fits_of(servo).beside(window, Known(state.gap, state.unknowns, offset, machine))
    if fit is None:
        return _without_result("no window was fitted before")
    bias, bias_std = quick_bias(window, servo)
    numbers = None if machine is None else machine.reading
    total = math.hypot(fit.std, state.model_std)
    result = Glance(fit.gap, fit.std, fit.misfit, bias, bias_std, True, "", numbers, total)
    why = due(message, state, settings) or _unclear(fit, state, settings) or _moved(result, fit, state, settings)
    return replace(result, moved=bool(why), why=why or "nothing moved")


def no_glance(why: str) -> Glance:
    """Record of a window that was not looked at, and need not be."""
    return _without_result(why, moved=False)


def _without_result(why: str, moved: bool = True) -> Glance:
    return Glance(math.nan, math.inf, math.nan, math.nan, math.inf, moved, why)


def _unclear(fit: QuickFit, state: TriageState, settings: TriageSettings) -> str:
    """Reason why a glance cannot decide whether the gap moved; empty: none."""
    if not fit.converged:
        return "the quick fit did not converge"
    if not fit.noise_std <= max(settings.widest_limit(state.gap), state.std):
        return f"at a glance the window shows the gap to {math.degrees(fit.noise_std):.3g} deg only"
    return ""


def _moved(result: Glance, fit: QuickFit, state: TriageState, settings: TriageSettings) -> str:
    """Change since the last estimate, in words; empty: none."""
    off, std = abs(result.gap - state.gap), math.hypot(result.std, state.std)
    usual, spread = max(state.misfit, settings.misfit_limit), NO_SPREAD
    if not (off <= allowed(std, state.gap, settings) and result.misfit <= settings.misfit * usual):
        # Only here does it matter what is open of the machine: it may be all that differs.
        spread = _open(fit, state.gap, settings)
    if not off <= allowed(math.hypot(std, spread.gap), state.gap, settings):
        now, before = math.degrees(result.gap), math.degrees(state.gap)
        return f"the gap moved: {now:.4g} deg at a glance, {before:.4g} deg estimated before"
    if not result.misfit <= settings.misfit * max(usual, spread.misfit):
        return f"a residual of {1e6 * result.misfit:.3g} um, where {1e6 * state.misfit:.3g} um is usual"
    spread_of_bias = settings.deviations * math.hypot(result.bias_std, state.bias_std)
    if abs(result.bias - state.bias) > max(settings.bias_limit, spread_of_bias):
        return f"the input bias moved: {result.bias:.4g} V, {state.bias:.4g} V before"
    return ""


def _open(fit: QuickFit, gap: float, settings: TriageSettings) -> MachineSpread:
    """Effect of what is open of the machine; none where it is so much that it could hide any move of the gap (rad)."""
    spread = fit.machine_spread()
    return spread if spread.gap <= settings.widest_limit(gap) else NO_SPREAD


def allowed(std: float, gap: float, settings: TriageSettings) -> float:
    """Largest difference (rad) of two estimates of one gap (rad), for a standard deviation (rad) of the difference."""
    return max(settings.gap_limit(gap), settings.deviations * std)


@dataclass(frozen=True)
class Triage:
    """The triage of one servo's windows.

    Parameters
    ----------
    servo : Servo or Axis
    settings : TriageSettings
    fits : QuickFits
        Of the servo's windows.
    """

    servo: Plant
    settings: TriageSettings
    fits: QuickFits

    @classmethod
    def of(cls, servo: Plant, settings: TriageSettings | None) -> Triage | None:
        """Make the triage that a twin's settings describe; None: they have none.

        Raises
        ------
        InvalidInput
            No window of this axis shows the gap.
        """
        return None if settings is None else cls(servo, settings, quick_fits_of(servo))

    def glance(
        self,
        state: TriageState,
        message: WindowMessage,
        window: Window,
        trend: Trend | None,
        requested: bool,
        machine: FactorPrior | None = None,
    ) -> tuple[TriageState, Glance | None]:
        """Glance at a window; None where that is not possible: the estimator then reports the reason.

        Parameters
        ----------
        state : TriageState
        message, window
            The window's message, and the decoded window.
        trend : Trend or None
            Trend after the accepted windows.
        requested : bool
            True while a request for a more informative window is pending: every window is estimated then.
        machine : FactorPrior, optional
            The machine's numbers over the servo's, as learnt.
        """
        compared = replace(state, doubt="a request is open", vain=0) if requested else state
        try:
            result = glance(
                message, prompt_window(window, self.servo), self.servo, compared, _offset(trend), self.settings, machine
            )
        except InvalidInput:
            return state, None
        return (state if result.moved else state.glanced(result)), result

    def estimated(
        self,
        state: TriageState,
        message: WindowMessage,
        window: Window | None,
        estimate: GapEstimate,
        trend: Trend | None,
        rejection: str,
        machine: FactorPrior | None = None,
    ) -> TriageState:
        """Return the state after an estimate; after a rejected one the next window is estimated too.

        Later glances are compared with the glance at the estimated window itself. Trend and `machine` are those after
        the estimate.
        """
        if rejection or window is None:
            boot, version = message.boot, message.parameter_version
            return replace(state, doubt=rejection, glances=0, vain=state.vain + 1, boot=boot, version=version)
        window, known = prompt_window(window, self.servo), Known(estimate.gap, (), _offset(trend), machine)
        known = known._replace(unknowns=self.fits.unknowns_at(window, known))
        fit = self.fits.beside(window, known)
        if fit is None:
            return state
        bias, bias_std = quick_bias(window, self.servo)
        return TriageState(
            doubt=self._misled(fit, estimate),
            boot=message.boot,
            version=message.parameter_version,
            time=estimate.time,
            gap=estimate.gap,
            std=estimate.std,
            model_std=math.sqrt(max(0.0, estimate.std_total**2 - estimate.std**2)),
            bias=bias,
            bias_std=bias_std,
            misfit=fit.misfit if math.isnan(state.misfit) else max(_FADES * state.misfit, fit.misfit),
            unknowns=known.unknowns,
        )

    def _misled(self, fit: QuickFit, estimate: GapEstimate) -> str:
        """Error of a glance, in words; empty where it is small enough."""
        off = abs(fit.gap - estimate.gap)
        std = math.hypot(fit.std, estimate.std)
        gap, settings = estimate.gap, self.settings
        if off <= allowed(std, gap, settings):
            return ""
        if off <= allowed(math.hypot(std, _open(fit, gap, settings).gap), gap, settings):
            return ""
        return f"a glance misled by {math.degrees(off):.3g} deg at the window that was estimated last"


def _offset(trend: Trend | None) -> tuple[float, float] | None:
    return Expectation(0.0, trend).offset
