"""Requests of a twin after a window, and the advice where they are not allowed. Pure."""

from __future__ import annotations

from msgspec.structs import replace

from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import Message, WindowMessage
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.estimating import UNUSABLE
from servotwin.twin.evidence import AlarmRecord, ExcitationRecord, Record
from servotwin.twin.model import TwinModel
from servotwin.twin.state import TwinState
from servotwin.twin.untold_ratio import NO_REQUESTS


def ask(
    model: TwinModel, state: TwinState, message: WindowMessage, estimate: GapEstimate, arrived: float, now: float
) -> tuple[TwinState, tuple[Message, ...], list[Record]]:
    """Decide after an estimate if a more informative window is requested; return the request, and the records.

    Parameters
    ----------
    model : TwinModel
    state : TwinState
    message : WindowMessage
    estimate : GapEstimate
        Of this window.
    arrived, now : float
        Time of its arrival and of this step, s.
    """
    if model.requests is None or state.requests is None or estimate.method == UNUSABLE:
        state, alarms = _advise(model, state, message, estimate, NO_REQUESTS)
        return state, (), alarms
    widest = state.wear.expect(model.settings.trend, message.boot, estimate.time, arrived).widest
    in_force = state.known.get(state.versions.in_force)
    asking, decision = model.requests.decide(state.requests, message, estimate, widest, in_force, now)
    records: list[Record] = [ExcitationRecord(message, decision)]
    state, alarms = _advise(model, replace(state, requests=asking), message, estimate, decision.prevented)
    if decision.ask is None or asking.pending is None:
        return state, (), [*records, *alarms]
    return state, (asking.pending,), [*records, asking.pending, *alarms]


def _advise(
    model: TwinModel, state: TwinState, message: WindowMessage, estimate: GapEstimate, prevented: str
) -> tuple[TwinState, list[Record]]:
    """Say once what to do where the ratio is not told and no moves that tell it are requested."""
    settings = model.settings.excitation or ExcitationSettings()
    ratio, sentence = state.ratio.after(estimate, prevented, settings)
    return replace(state, ratio=ratio), [AlarmRecord(message, sentence)] if sentence else []
