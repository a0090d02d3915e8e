"""State of a twin: its knowledge of the servo, as one frozen value that is stored unchanged.

MessagePack with a tag that carries the schema's version, every float with all its bits, arrays as lists. The settings
are no part of the state: a twin that is restored under other settings uses those.
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import Struct

from servotwin.errors import InvalidInput
from servotwin.messages import Gains, Setting
from servotwin.messages.legacy import upgrade
from servotwin.twin.estimating import Wear
from servotwin.twin.lookups import LookupState
from servotwin.twin.requests import RequestState
from servotwin.twin.responses import ResponseState
from servotwin.twin.triage import TriageState
from servotwin.twin.versions import Attempts, Versions


class TwinState(Struct, frozen=True, tag="twin-state/2"):
    """State of the twin of one servo.

    Attributes
    ----------
    servo : str
    versions : Versions
    known : dict of int to Setting
        Setting of each version of the parameters, as far as it is known.
    wear : Wear
    attempts : Attempts
        Sendings of the pending update.
    tuned_for : float or None
        rad, gap of the last redesign.
    rests : tuple of float
        V, input biases that the last windows showed, the newest last.
    steps : tuple of float
        m, sizes of the reference's steps in the last windows, the newest last.
    other_controller : int
        Windows in a row whose voltage is not that of the controller stated for them.
    requests, triage, lookups, responses : RequestState, TriageState, LookupState, ResponseState, or None
        State of the optional parts; None: the twin has no such part.
    """

    servo: str
    versions: Versions
    known: dict[int, Setting]
    wear: Wear
    attempts: Attempts = Attempts()
    tuned_for: float | None = None
    requests: RequestState | None = None
    triage: TriageState | None = None
    lookups: LookupState | None = None
    rests: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    responses: ResponseState | None = None
    other_controller: int = 0


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(TwinState)


def encode_state(state: TwinState) -> bytes:
    """Encode a state; equal states give equal bytes."""
    return _encoder.encode(state)


def decode_state(servo: str, data: bytes) -> TwinState:
    """Decode the state of a servo, in this version's schema or the previous one.

    Raises
    ------
    InvalidInput
        The bytes are not such a state, or belong to another servo.
    """
    try:
        try:
            state = _decoder.decode(data)
        except msgspec.ValidationError:
            document = msgspec.msgpack.decode(data)
            if not isinstance(document, dict) or document.get("type") != "twin-state/1":
                raise
            state = msgspec.convert(_upgraded(document), TwinState)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError, LookupError, TypeError) as error:
        raise InvalidInput(f"the state of servo {servo!r} is not understood: {error}") from None
    if state.servo != servo:
        raise InvalidInput(f"the state of servo {servo!r} belongs to {state.servo!r}; each servo needs its own")
    return state


def _upgraded(old: dict[str, Any]) -> dict[str, Any]:
    """Convert a document of the previous schema, in which a known setting was a whole controller."""
    versions, wear, requests = old["versions"], old["wear"], old["requests"]
    known = {version: _setting(one) for version, one in old["known"].items() if one["tolerance"] is not None}
    return {
        "type": "twin-state/2",
        "servo": old["servo"],
        "versions": {
            "boot": versions["boot"],
            "in_force": versions["in_force"],
            "issued": versions["issued"],
            "pending": upgrade(versions["pending"]),
            "data_time": versions["newest"],
            "ended_boots": versions["earlier"],
            "root": versions.get("root", 0),
        },
        "known": known,
        "wear": {
            "previous": wear["previous"], "boot": wear["boot"], "arrived": wear["heard"], "state": wear["trend"],
        },
        "attempts": {"sent_at": old["sent_at"], "count": old["attempts"]},
        "tuned_for": old["tuned_for"],
        "requests": requests
        and {
            "pending": requests["pending"],
            "excitation": requests["memory"],
            "boot": requests["boot"],
            "serial": requests["serial"],
            "attempts": {"sent_at": requests["sent_at"], "count": requests["attempts"]},
        },
        "triage": old.get("watch"),
        "lookups": old.get("lookups"),
    }  # fmt: skip


def _setting(old: dict[str, Any]) -> dict[str, Any]:
    law = old["controller"]
    gains = None if law is None else {name: law[name] for name in Gains.__struct_fields__ if name in law}
    return {"tolerance": old["tolerance"], "gains": gains}
