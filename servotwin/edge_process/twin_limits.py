"""Limits that the twin has told its edges, and what of an edge's file goes beyond them."""

from __future__ import annotations

from servotwin.edge.settings import AgentSettings
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
