"""Limits that the twin has told its edges, what of an edge's file goes beyond them, and a twin of another version."""

from __future__ import annotations

from servotwin.edge.settings import AgentSettings
from servotwin.link.session import Receiver, Session
from servotwin.messages import ClaimStatus


def limits_told(twin: ClaimStatus | None) -> dict[str, int]:
    """Limits of the twin, as it has told them; 0: it has not."""
    if twin is None:
        return {"samples_per_window": 0, "bytes_per_day": 0}
    return {"samples_per_window": twin.samples_per_window, "bytes_per_day": twin.bytes_per_day}


def window_trouble(agent: AgentSettings, twin: ClaimStatus | None) -> str:
    """Key of the edge's file by which the twin will refuse windows for their length; empty: there is none."""
    if twin is None or not twin.samples_per_window:
        return ""
    most = twin.samples_per_window
    lengths = {"window_s": agent.window_s, "longest_window_s": agent.longest_window_s or 0.0}
    for name, seconds in lengths.items():
        if (samples := round(seconds * agent.sample_rate)) > most:
            return f"{name} = {seconds!r} s has {samples} samples; the twin takes at most {most} and refuses longer"
    return ""


def version_trouble(session: Session, receiver: Receiver | None) -> str:
    """Messages that the older one of edge and twin does not know; empty: there are none."""
    if session.not_known:
        return (
            "the twin is older than this edge and does not know a message, which waits until the twin is upgraded "
            f"({session.not_known})"
        )
    if receiver is not None and receiver.not_known:
        number = f"{receiver.not_known} message{'s' if receiver.not_known > 1 else ''}"
        return f"the twin is newer than this edge and has sent {number} that the edge does not know; upgrade the edge"
    return ""
