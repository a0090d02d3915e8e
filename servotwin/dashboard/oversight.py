"""Present oversight of a machine: who holds it, what waits for an approval, and what was done, from the store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from servotwin.dashboard.evidence_body import body_of
from servotwin.messages.acts import ActKind
from servotwin.store import overview
from servotwin.store.records import StoredEvidence

_ACTS, _SHOWN, _UPDATES = 5000, 200, 20
"""Newest acts that are read, since one of long ago may hold still, and that are shown; updates and proposals."""
_WAITS = "waits for the next window"
_HOLDS = (ActKind.HOLD, ActKind.ROLL_BACK)


def machine_oversight(connection: sa.Connection, servo: str) -> dict[str, Any]:
    """Read the oversight of a servo."""
    acts = overview.evidence_of_kinds(connection, servo, ("act",), _ACTS)
    sent = overview.evidence_of_kinds(connection, servo, ("proposal", "update"), _UPDATES)
    return present_oversight(sorted([*acts, *sent], key=lambda record: record.id))


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
        acts : the newest ones first, each with `refused` (a reason, or empty) and `outcome` in words.
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
        if act.pop("later"):
            _note_outcome(acts, act)
            continue
        acts.insert(0, act)
        if act["refused"]:
            continue
        _end_waiting(acts)
        kind = act.get("act")
        held = act if kind in _HOLDS else None if kind == ActKind.RELEASE else held
        ask_first = kind == ActKind.ASK_FIRST or (ask_first and kind != ActKind.ASK_NO_MORE)
        proposal = None if kind in (*_HOLDS, ActKind.ASK_NO_MORE) else proposal
    return {"held": held, "ask_first": ask_first, "proposal": proposal, "acts": acts[:_SHOWN]}


def _note_outcome(acts: list[dict[str, Any]], later: dict[str, Any]) -> None:
    """Give the roll back that waited what became of it."""
    for act in acts:
        if act["outcome"] == _WAITS:
            refused = later["refused"]
            act.update(refused=refused, outcome=f"not sent: {refused}" if refused else "sent")
            return


def _end_waiting(acts: list[dict[str, Any]]) -> None:
    """The newest act ends the wait of an earlier roll back, where it is one of those that do."""
    if acts[0].get("act") in (*_HOLDS, ActKind.RELEASE):
        for act in acts[1:]:
            if act["outcome"] == _WAITS:
                act["outcome"] = "ended by a later act"


def _act(record: StoredEvidence) -> dict[str, Any]:
    body = body_of(record)
    stored = body if isinstance(body, dict) else {}
    act = stored.get("act")
    known = {key: value for key, value in act.items() if key != "type"} if isinstance(act, dict) else {}
    refused, later = str(stored.get("refused", "")), stored.get("later")
    # Records of earlier versions know nothing of what came later.
    waits = not refused and later is False and known.get("act") == ActKind.ROLL_BACK
    outcome = f"refused: {refused}" if refused else _WAITS if waits else "done"
    return {**known, "refused": refused, "outcome": outcome, "later": bool(later), "done": record.created}


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
