"""Everything that a twin knows of its servo, as bytes: what a deployed twin is between two messages.

MessagePack with a tag that carries the schema's version, every float with all its bits, arrays as lists. What the
settings say is no part of it: a twin restored under other settings goes on with these.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from servotwin.errors import InvalidInput
from servotwin.estimation.trend import Trend, TrendSettings
from servotwin.messages import Gains, Request, Setting, Update
from servotwin.messages.legacy import upgrade
from servotwin.redesign.excitation import Memory
from servotwin.redesign.policy import Policy
from servotwin.twin.delivery import Delivery
from servotwin.twin.glance import Watch
from servotwin.twin.in_force import Settings
from servotwin.twin.lookups import Lookups
from servotwin.twin.lookups import Memory as LookupMemory
from servotwin.twin.requests import Requests
from servotwin.twin.triage import Triage
from servotwin.twin.versions import Versions
from servotwin.twin.wear import Wear

_Mean = Annotated[tuple[float, ...], Meta(min_length=3, max_length=3)]
_Covariance = Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)]


class TrendState(Struct, frozen=True):
    """A `Trend` but for its settings; `covariance` row by row."""

    time: float
    mean: _Mean
    covariance: _Covariance
    updates: int
    refused: int
    reasons: tuple[str, ...]
    rival: TrendState | None


class WearState(Struct, frozen=True):
    """A `Wear` but for its settings."""

    previous: float
    boot: str
    heard: float
    trend: TrendState | None


class VersionsState(Struct, frozen=True):
    """A `Versions`."""

    boot: str | None
    in_force: int
    issued: int
    pending: Update | None
    newest: float
    earlier: tuple[str, ...]
    root: int = 0


class RequestsState(Struct, frozen=True):
    """What `Requests` remembers."""

    pending: Request | None
    memory: Memory
    boot: str
    serial: int
    sent_at: float
    attempts: int


class TwinState(Struct, frozen=True, tag="twin-state/2"):
    """What a `Twin` remembers."""

    servo: str
    versions: VersionsState
    known: dict[int, Setting]
    wear: WearState
    requests: RequestsState | None
    tuned_for: float | None
    sent_at: float
    attempts: int
    watch: Watch | None = None
    lookups: LookupMemory | None = None


class Knowledge(NamedTuple):
    """The parts of a twin that remember, and the gap (rad) of the last redesign."""

    versions: Versions
    known: Settings
    wear: Wear
    requests: Requests | None
    delivery: Delivery
    tuned_for: float | None
    triage: Triage | None = None
    policy: Policy | None = None


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(TwinState)


def pack(servo: str, knows: Knowledge) -> bytes:
    """The state's bytes; equal knowledge gives equal bytes."""
    state = TwinState(
        servo,
        _versions(knows.versions),
        dict(sorted(knows.known.by_version.items())),
        _wear(knows.wear),
        None if knows.requests is None else _requests(knows.requests),
        None if knows.tuned_for is None else float(knows.tuned_for),
        knows.delivery.sent_at,
        knows.delivery.attempts,
        None if knows.triage is None else knows.triage.watch,
        knows.policy.memory if isinstance(knows.policy, Lookups) else None,
    )
    return _encoder.encode(state)


def unpack(servo: str, data: bytes, fresh: Knowledge) -> Knowledge:
    """What the bytes say; `fresh` is a new twin's, whose settings stay.

    Raises
    ------
    InvalidInput
        The bytes are no state of this schema, or another servo's.
    """
    try:
        state = _decoded(data)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
        raise InvalidInput(f"the state of servo {servo!r} is not understood: {error}") from None
    if state.servo != servo:
        raise InvalidInput(f"the state of servo {servo!r} is that of {state.servo!r}; each servo needs its own")
    return Knowledge(
        _restored_versions(state.versions),
        Settings(state.known),
        _restored_wear(fresh.wear, state.wear),
        _restored_requests(fresh.requests, state.requests),
        replace(fresh.delivery, sent_at=state.sent_at, attempts=state.attempts),
        state.tuned_for,
        _restored_triage(fresh.triage, state.watch),
        _restored_policy(fresh.policy, state.lookups),
    )


def _decoded(data: bytes) -> TwinState:
    """The state in these bytes; that of the version before is converted."""
    try:
        return _decoder.decode(data)
    except msgspec.ValidationError:
        document = msgspec.msgpack.decode(data, strict=False)
        if not isinstance(document, dict) or document.get("type") != "twin-state/1":
            raise
    versions = document["versions"]
    known = {version: _setting(one) for version, one in document["known"].items()}
    return msgspec.convert(
        {
            **document,
            "type": "twin-state/2",
            "versions": {**versions, "pending": upgrade(versions["pending"])},
            "known": {version: setting for version, setting in known.items() if setting is not None},
        },
        TwinState,
    )


def _setting(known: dict[str, Any]) -> Setting | None:
    """The setting that the version before kept as a whole controller and a tolerance, each None where not known."""
    law, tolerance = known["controller"], known["tolerance"]
    if tolerance is None:
        return None
    return Setting(tolerance, None if law is None else Gains(*(law[name] for name in Gains.__struct_fields__)))


def trend_state(trend: Trend) -> TrendState:
    """A trend as plain numbers."""
    return TrendState(
        time=float(trend.time),
        mean=tuple(trend.mean.tolist()),
        covariance=tuple(trend.covariance.ravel().tolist()),
        updates=trend.updates,
        refused=trend.refused,
        reasons=trend.reasons,
        rival=None if trend.rival is None else trend_state(trend.rival),
    )


def restored_trend(state: TrendState, settings: TrendSettings) -> Trend:
    """The trend, bit for bit."""
    return Trend(
        time=state.time,
        mean=np.array(state.mean),
        covariance=np.array(state.covariance).reshape(3, 3),
        settings=settings,
        updates=state.updates,
        refused=state.refused,
        reasons=state.reasons,
        rival=None if state.rival is None else restored_trend(state.rival, settings),
    )


def _versions(versions: Versions) -> VersionsState:
    v = versions
    return VersionsState(v.boot, v.in_force, v.issued, v.pending, v.newest, tuple(v.earlier), v.root)


def _restored_versions(state: VersionsState) -> Versions:
    s = state
    return Versions(s.boot, s.in_force, s.issued, s.pending, s.newest, list(s.earlier), s.root)


def _wear(wear: Wear) -> WearState:
    trend = None if wear.trend is None else trend_state(wear.trend)
    return WearState(float(wear.previous), wear.boot, wear.heard, trend)


def _restored_wear(fresh: Wear, state: WearState) -> Wear:
    wear = Wear(state.previous, fresh.settings)
    wear.boot, wear.heard = state.boot, state.heard
    wear.trend = None if state.trend is None else restored_trend(state.trend, fresh.settings)
    return wear


def _requests(requests: Requests) -> RequestsState:
    r = requests
    return RequestsState(r.pending, r.memory, r.boot, r.serial, r.sent_at, r.attempts)


def _restored_requests(fresh: Requests | None, state: RequestsState | None) -> Requests | None:
    """As the settings want them: none where nothing is asked for any more."""
    if fresh is not None and state is not None:
        for name in RequestsState.__struct_fields__:
            setattr(fresh, name, getattr(state, name))
    return fresh


def _restored_triage(fresh: Triage | None, watch: Watch | None) -> Triage | None:
    """As the settings want it: without what it remembers, it begins anew."""
    if fresh is not None and watch is not None:
        fresh.watch = watch
    return fresh


def _restored_policy(fresh: Policy | None, memory: LookupMemory | None) -> Policy | None:
    """As the settings want it: what was withdrawn stays so."""
    if isinstance(fresh, Lookups) and memory is not None:
        fresh.memory = memory
    return fresh
