"""Which windows need the estimator: all get a glance, and those that may say something new are estimated.

A glance takes the plain fit next to the gap that was estimated last, and compares. Nothing moved only where that was
possible to see: a window that does not show the gap, a fit that does not settle, and anything unusual is estimated, and
the reason kept. After every estimate the glance at the same window is compared with it: a servo on which glances
mislead gets none.
"""

from __future__ import annotations

import math

import msgspec
from msgspec import Struct

from servotwin.estimation.disturbance import quick_bias
from servotwin.estimation.whitened.quick import QuickFit, quick_fit
from servotwin.estimation.window import Window
from servotwin.messages import Window as WindowMessage
from servotwin.plant.servo import Servo
from servotwin.twin.settings import TriageSettings

ROUTINE = ("reference", "periodic")
"""Reasons of windows that come anyway; any other says that something is new, or was asked for."""

_SHORTEST = 400  # samples, as for the estimator
_PATIENCE, _SPARSE = 3, 8  # estimates in a row that did not count, after which only one window in so many is tried


class Watch(Struct, frozen=True):
    """What glances are compared with: a part of the twin's state.

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


class Glance(Struct, frozen=True):
    """What a glance saw.

    Attributes
    ----------
    gap, std : float
        rad; NaN and inf where it saw none.
    misfit : float
        m.
    bias, bias_std : float
        V; NaN and inf where nothing rests.
    moved : bool
        Whether the window is to be estimated.
    why : str
        Why, in words; where it is not, what was found.
    """

    gap: float
    std: float
    misfit: float
    bias: float
    bias_std: float
    moved: bool
    why: str


def due(message: WindowMessage, watch: Watch, settings: TriageSettings) -> str:
    """Why a window is estimated whatever it shows; empty: a glance may be enough."""
    if watch.doubt:
        return watch.doubt
    if message.boot != watch.boot:
        return "the edge has started anew"
    if message.reason not in ROUTINE:
        return f"the edge sent it because of: {message.reason or 'nothing stated'}"
    if watch.glances + 1 >= settings.every:
        return f"due: {watch.glances} windows since the last estimate"
    if abs(message.middle - watch.time) >= settings.longest:
        return f"due: {abs(message.middle - watch.time):.6g} s since the last estimate"
    return ""


def in_vain(message: WindowMessage, watch: Watch) -> str:
    """Why a window is not even looked at: estimates of such windows have said nothing lately; empty: it is.

    A loop that always shows one contact, of an encoder whose offset is not known, would be estimated for ever.
    """
    changed = (message.boot, message.parameter_version) != (watch.boot, watch.version) or message.reason not in ROUTINE
    if changed or watch.vain < _PATIENCE or watch.glances + 1 >= _SPARSE:
        return ""
    return f"not looked at: {watch.vain} estimates in a row did not count, and one window in {_SPARSE} is tried"


def glance(
    message: WindowMessage,
    window: Window,
    servo: Servo,
    watch: Watch,
    offset: tuple[float, float] | None = None,
    settings: TriageSettings | None = None,
) -> Glance:
    """Whether a window has to be estimated.

    Parameters
    ----------
    message : messages.Window
        For its boot, version and reason.
    window : Window
        The same, decoded.
    servo : Servo
    watch : Watch
    offset : (float, float), optional
        The encoder's offset as earlier windows showed it, mean and standard deviation, rad.
    settings : TriageSettings, optional
    """
    settings, tired = settings or TriageSettings(), in_vain(message, watch)
    if tired:
        return _blind(tired, moved=False)
    if window.theta_m is None or window.position.size < _SHORTEST:
        return _blind("the window has no theta_m, or too few samples: what to make of it, the estimator says")
    if not (math.isfinite(watch.gap) and float(window.theta_m.max() - window.theta_m.min()) > 0.0):
        return _blind(watch.doubt or "the motor's angle is constant")
    seen = quick_fit(window, servo, watch.gap, offset)
    bias, bias_std = quick_bias(window, servo)
    told = Glance(seen.gap, seen.std, seen.misfit, bias, bias_std, True, "")
    why = due(message, watch, settings) or _unclear(seen, settings) or _moved(told, watch, settings)
    return msgspec.structs.replace(told, moved=bool(why), why=why or "nothing moved")


def _blind(why: str, moved: bool = True) -> Glance:
    return Glance(math.nan, math.inf, math.nan, math.nan, math.inf, moved, why)


def _unclear(seen: QuickFit, settings: TriageSettings) -> str:
    """Why a glance cannot say whether the gap moved."""
    if not seen.settled:
        return "the plain fit did not settle"
    if not seen.std <= settings.widest:
        return f"at a glance the window shows the gap to {math.degrees(seen.std):.3g} deg only"
    return ""


def _moved(seen: Glance, watch: Watch, settings: TriageSettings) -> str:
    """What moved since the last estimate, in words; empty: nothing."""
    off = abs(seen.gap - watch.gap)
    if not off <= allowed(math.hypot(seen.std, watch.std), settings):
        now, before = math.degrees(seen.gap), math.degrees(watch.gap)
        return f"the gap moved: {now:.4g} deg at a glance, {before:.4g} deg estimated before"
    if not seen.misfit <= settings.misfit * max(watch.misfit, settings.least_misfit):
        return f"{1e6 * seen.misfit:.3g} um are left over, and {1e6 * watch.misfit:.3g} um are usual"
    spread = settings.deviations * math.hypot(seen.bias_std, watch.bias_std)
    if abs(seen.bias - watch.bias) > max(settings.bias, spread):
        return f"the input bias moved: {seen.bias:.4g} V, {watch.bias:.4g} V before"
    return ""


def allowed(std: float, settings: TriageSettings) -> float:
    """rad by which gaps may differ that are one, for a spread (rad) of their difference."""
    return max(settings.gap, settings.deviations * std)
