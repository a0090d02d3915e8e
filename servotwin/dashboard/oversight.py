"""Present oversight of a machine: who holds it, what waits for an approval, and what was done, from the store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from servotwin.dashboard.evidence_body import body_of
from servotwin.messages.acts import ActKind
from servotwin.store import overview
from servotwin.store.records import StoredEvidence

_ACTS = 200
"""Acts that are read; older ones are in the store only."""
_HOLDS = (ActKind.HOLD, ActKind.ROLL_BACK)


def machine_oversight(connection: sa.Connection, servo: str) -> dict[str, Any]:
    """Read the oversight of a servo."""
    records = overview.evidence_of_kinds(connection, servo, ("act", "proposal", "update"), _ACTS)
    return present_oversight(records)


def present_oversight(records: Sequence[StoredEvidence]) -> dict[str, Any]:
    """Compose what holds now.

    Parameters
    ----------
    records : sequence of StoredEvidence
        Of the kinds act, proposal and update, oldest first.

    Returns
    -------
    dict
        held : the act that holds the machine, or None; ask_first : bool; proposal : the update that waits, or None;
        acts : all of them, newest first, each with `refused`.
    """
    held: dict[str, Any] | None = None
    ask_first, proposal, acts = False, None, list[dict[str, Any]]()
    for record in records:
        if record.kind == "proposal":
            proposal = _proposal(record)
            continue
        if record.kind == "update":
            proposal = None if _window_of(record) == _window_of_proposal(proposal) else proposal
            continue
        act = _act(record)
        acts.insert(0, act)
        if act["refused"]:
            continue
        kind = act.get("act")
        held = act if kind in _HOLDS else None if kind == ActKind.RELEASE else held
        ask_first = kind == ActKind.ASK_FIRST or (ask_first and kind != ActKind.ASK_NO_MORE)
        proposal = None if kind in (*_HOLDS, ActKind.ASK_NO_MORE) else proposal
    return {"held": held, "ask_first": ask_first, "proposal": proposal, "acts": acts}


def _act(record: StoredEvidence) -> dict[str, Any]:
    body = body_of(record)
    stored = body if isinstance(body, dict) else {}
    act = stored.get("act")
    known = {key: value for key, value in act.items() if key != "type"} if isinstance(act, dict) else {}
    return {**known, "refused": str(stored.get("refused", "")), "done": record.created}


def _proposal(record: StoredEvidence) -> dict[str, Any]:
    body = body_of(record)
    stored = body if isinstance(body, dict) else {}
    shown = ("window", "gap", "interval", "setting", "data_time", "not_after", "verification")
    return {"created": record.created, **{key: stored.get(key) for key in shown}}


def _window_of(record: StoredEvidence) -> object:
    body = body_of(record)
    return body.get("window") if isinstance(body, dict) else None


def _window_of_proposal(proposal: dict[str, Any] | None) -> object:
    return None if proposal is None else proposal["window"]
