"""The triage of one servo's windows: a glance at each, and what it is compared with.

After every estimate the glance at the same window is compared with it: where glances mislead, all are estimated.
"""

from __future__ import annotations

import math

import msgspec

from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import quick_bias
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.estimation.whitened.quick import QuickFit, quick_fit
from servotwin.messages import Window as WindowMessage
from servotwin.plant.servo import Servo
from servotwin.twin.decode import decode_window
from servotwin.twin.glance import Glance, Watch, allowed, glance
from servotwin.twin.requests import Requests
from servotwin.twin.settings import TriageSettings
from servotwin.twin.store import Store
from servotwin.twin.wear import Expectation

_FADES = 0.95  # of the usual misfit, per window: steps to one side may leave more than those to the other


class Triage:
    """The triage of one servo: it remembers what it compares with.

    Parameters
    ----------
    servo : Servo
    settings : TriageSettings

    Attributes
    ----------
    watch : Watch
    """

    def __init__(self, servo: Servo, settings: TriageSettings) -> None:
        self.servo, self.settings, self.watch = servo, settings, Watch()

    def spares(self, message: WindowMessage, trend: Trend | None, asks: Requests | None, store: Store) -> bool:
        """Whether a glance at a window is enough; what it saw is stored.

        Parameters
        ----------
        message : messages.Window
        trend : Trend or None
            As it was left by the windows that counted.
        asks : Requests or None
            While the edge is asked for a window that tells more, all are estimated.
        store : Store
        """
        asked = asks is not None and asks.pending is not None
        watch = msgspec.structs.replace(self.watch, doubt="a request is open", vain=0) if asked else self.watch
        try:
            seen = glance(message, decode_window(message), self.servo, watch, _offset(trend), self.settings)
        except InvalidInput:
            return False  # why it is no window, the estimator says
        store.add_glance(message, seen)
        if not seen.moved:
            self.watch = _glanced(self.watch, seen)
        return not seen.moved

    def doubt(self, why: str) -> None:
        """The next window is estimated, whatever it shows."""
        self.watch = msgspec.structs.replace(self.watch, doubt=why, glances=0, vain=0)

    def learn(self, message: WindowMessage, estimate: GapEstimate, trend: Trend | None, why_not: str) -> None:
        """Note an estimate, and why it does not count, where it does not: then the next window is estimated too.

        What a glance at its own window says is what later ones are compared with.
        """
        if why_not:
            whose = {"boot": message.boot, "version": message.parameter_version}
            self.watch = msgspec.structs.replace(
                self.watch, doubt=why_not, glances=0, vain=self.watch.vain + 1, **whose
            )
            return
        window, before = decode_window(message), self.watch.misfit
        seen = quick_fit(window, self.servo, estimate.gap, _offset(trend))
        bias, bias_std = quick_bias(window, self.servo)
        self.watch = Watch(
            self._misled(seen, estimate),
            message.boot,
            message.parameter_version,
            estimate.time,
            estimate.gap,
            estimate.std,
            bias,
            bias_std,
            seen.misfit if math.isnan(before) else max(_FADES * before, seen.misfit),
        )

    def _misled(self, seen: QuickFit, estimate: GapEstimate) -> str:
        """By how much a glance was wrong, in words; empty where it was not."""
        off = abs(seen.gap - estimate.gap)
        if off <= allowed(math.hypot(seen.std, estimate.std), self.settings):
            return ""
        return f"a glance misled by {math.degrees(off):.3g} deg at the window that was estimated last"


def _glanced(watch: Watch, seen: Glance) -> Watch:
    """After a window of which a glance was enough."""
    usual = watch.misfit if math.isnan(seen.misfit) else max(_FADES * watch.misfit, seen.misfit)
    return msgspec.structs.replace(watch, misfit=usual, glances=watch.glances + 1)


def _offset(trend: Trend | None) -> tuple[float, float] | None:
    return Expectation(0.0, trend).offset
