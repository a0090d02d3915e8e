"""The learnt structure for the edge: sent when it has become clearly better, until windows name it. Optional, pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from servotwin.errors import InvalidInput
from servotwin.estimation.axis_model import servo_for
from servotwin.estimation.core.response import response
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.estimation.whitened.quick import quick_fit
from servotwin.messages import LearntResponse, WindowMessage
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo
from servotwin.twin.estimating import DecodedWindow
from servotwin.twin.settings import TwinSettings

# Every response makes the edge learn its baseline anew: standard deviations, as they were when it was sent, by which a
# number must have moved; the gap's spread over that sent, below which it counts as clearly better known.
_MOVED, _BETTER = 3.0, 0.5


class ResponseState(Struct, frozen=True):
    """Part of the twin's state that belongs to the response that was sent last.

    Attributes
    ----------
    version : int
        0: none was sent.
    factors, stds : tuple of float
        The machine's numbers that it stands on, and their standard deviations then.
    gap, gap_std : float
        rad: of the window that taught them, and the standard deviation of a window's gap due to what was open of them.
    sent_at : float
        s, on the twin's clock.
    """

    version: int = 0
    factors: tuple[float, ...] = ()
    stds: tuple[float, ...] = ()
    gap: float = 0.0
    gap_std: float = math.inf
    sent_at: float = -math.inf


@dataclass(frozen=True)
class Responses:
    """Decides after each window if the edge is sent a response.

    Parameters
    ----------
    servo : Servo
    retry : float
        s, after which a response that no window names is sent again.
    """

    servo: Servo
    retry: float

    @classmethod
    def of(cls, servo: Plant, settings: TwinSettings) -> Responses | None:
        """Make the part that a twin's settings describe; None: the twin learns no structure."""
        model = servo_for(servo)
        return cls(model, settings.retry) if settings.learning.learn and model is not None and model.rigid else None

    def after(
        self,
        state: ResponseState,
        decoded: DecodedWindow,
        now: float,
        estimate: GapEstimate | None = None,
        machine: FactorPrior | None = None,
    ) -> tuple[ResponseState, LearntResponse | None]:
        """Return the state after a window, and the response to send; None: none.

        Parameters
        ----------
        state : ResponseState
        decoded : DecodedWindow
        now : float
            s, on the twin's clock.
        estimate : GapEstimate, optional
            Of this window, where it counted.
        machine : FactorPrior, optional
            The machine's numbers over the servo's, as learnt with this window.
        """
        used = decoded.message.response_version
        if used is None:
            return state, None
        # Only a window that taught something can change what was learnt.
        if estimate is not None and estimate.machine is not None and machine is not None:
            following = self._following(state, decoded, estimate, machine, used, now)
            if following is not None:
                return following, self._response(following, decoded.message)
        # A clock that was set back delays nothing.
        if state.version <= used or 0.0 <= now - state.sent_at < self.retry:
            return state, None
        state = replace(state, sent_at=now)
        return state, self._response(state, decoded.message)

    def _following(
        self,
        state: ResponseState,
        decoded: DecodedWindow,
        estimate: GapEstimate,
        machine: FactorPrior,
        used: int,
        now: float,
    ) -> ResponseState | None:
        """State with a new response; None where the one that was sent is still as good."""
        if decoded.window is None:
            return None
        try:
            fit = quick_fit(decoded.window, self.servo, estimate.gap, None, machine)
        except InvalidInput:
            return None
        if not math.isfinite(fit.std):
            return None
        gap_std, factors = fit.machine_spread().gap, machine.mean
        # A twin that has lost its state does not know what the edge uses.
        known = state.version > 0 and used <= state.version
        if known and not gap_std < _BETTER * state.gap_std:
            moved = np.abs(factors - np.array(state.factors)) > _MOVED * np.array(state.stds)
            if not np.any(moved):
                return None
        stds = np.sqrt(np.diag(machine.covariance))
        version = max(state.version, used) + 1
        gap = max(0.0, float(estimate.gap))
        return ResponseState(version, tuple(factors.tolist()), tuple(stds.tolist()), gap, gap_std, now)

    def _response(self, state: ResponseState, message: WindowMessage) -> LearntResponse:
        """Response that a state describes, at the rate of a window."""
        known = response(adapted(self.servo, np.array(state.factors)), message.rate)
        modes = np.hstack([known.decay, known.position.gain]).tolist()
        return LearntResponse(
            servo=message.servo,
            version=state.version,
            rate=message.rate,
            modes=tuple(tuple(mode) for mode in modes),
            direct=known.position.direct,
            static_gain=known.static_gain,
            unseen=known.unseen,
            gap=state.gap,
            gap_std=state.gap_std,
        )
