"""Result of a co-simulation: the trajectory, and every message on the link."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servotwin.cosim.scenario import Scenario
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.passage import Passage
from servotwin.link.simulated import Fate
from servotwin.messages import Answer, Fallback, Message, Receipt, Request, Update, WindowMessage, decode
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.runtime.notebook import html_table
from servotwin.simulation import Run
from servotwin.simulation.views import arrow_table, legend_above, pandas_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAJECTORY = ("position", "theta_m", "theta_d", "voltage", "measured_position", "tolerance")


@dataclass(frozen=True)
class MessageCopy:
    """One copy of a message on its way.

    Attributes
    ----------
    direction : str
        "up", edge to twin, or "down".
    serial, copy : int
        The message's number in its direction; 1 for a duplicate.
    data : bytes
    sent, arrival : float
        s; a lost copy has the arrival that it would have had.
    fate : Fate
    """

    direction: str
    serial: int
    copy: int
    data: bytes
    sent: float
    arrival: float
    fate: Fate

    @property
    def message(self) -> Message:
        """The decoded message."""
        return decode(self.data)


@dataclass(frozen=True, repr=False)
class Loop:
    """Result of a co-simulation.

    Attributes
    ----------
    scenario : Scenario
    run : Run
        The trajectory.
    windows : tuple of messages.WindowMessage
        As decoded by the twin, without repetitions, in the order of arrival.
    estimates : tuple of GapEstimate
        One for each window.
    disturbances : tuple of Disturbance
        Input bias and noise, one for each window.
    trends : tuple of Trend or None
        The twin's gap and rate of wear after each window; None before the first accepted estimate.
    redesigns : tuple of Redesign
        Redesign after each window, or the reason why there is none.
    updates : tuple of messages.Update
        Every version that the twin sent.
    receipts : tuple of messages.Receipt
        Every decision of the edge, in order, repeated answers included.
    fallbacks : tuple of messages.Fallback
        Every return of the edge to the fallback set, with time and reason.
    excitations : tuple of redesign.excitation.Decision
        Decision for or against a request after each window that the twin considered, with the reason.
    requests : tuple of messages.Request
        Every request of the twin for more informative windows.
    answers : tuple of messages.Answer
        Every answer of the edge to a request, repeated answers included.
    messages : tuple of MessageCopy
        Every copy of every message, in the order of sending.
    accounts : Counter
        Windows cut by the edge, by fate: "delivered", "in flight" (in the outbox, not at the twin), or the reason for
        which they were dropped.
    """

    scenario: Scenario
    run: Run
    windows: tuple[WindowMessage, ...]
    estimates: tuple[GapEstimate, ...]
    disturbances: tuple[Disturbance, ...]
    trends: tuple[Trend | None, ...]
    redesigns: tuple[Redesign, ...]
    updates: tuple[Update, ...]
    receipts: tuple[Receipt, ...]
    fallbacks: tuple[Fallback, ...]
    excitations: tuple[Decision, ...]
    requests: tuple[Request, ...]
    answers: tuple[Answer, ...]
    messages: tuple[MessageCopy, ...]
    accounts: Counter[str]

    @property
    def applied(self) -> tuple[Receipt, ...]:
        """The first receipt of each update that was applied, in order."""
        first = {receipt.version: receipt for receipt in reversed(self.receipts) if receipt.applied}
        return tuple(sorted(first.values(), key=lambda receipt: receipt.sample))

    @property
    def trend(self) -> Trend | None:
        """Gap and wear rate at the end; None before the first accepted estimate."""
        return self.trends[-1] if self.trends else None

    @property
    def until_limit(self) -> Passage | None:
        """Time from `trend.time` until the gap reaches the scenario's `gap_limit`; None without limit or trend."""
        limit = self.scenario.twin.gap_limit
        return None if limit is None or self.trend is None else self.trend.time_until(limit)

    def __repr__(self) -> str:
        """Scenario, windows, updates and the newest trend in one line."""
        return f"<{self._title}, {self.trend!r}>"

    @property
    def _title(self) -> str:
        counts = f"windows: {len(self.windows)}, updates: {len(self.updates)} sent, {len(self.applied)} applied"
        return f"Loop {self.scenario.name!r}: {self.scenario.duration:g} s, {counts}"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        rows = {
            "scenario": repr(self.scenario),
            "windows": str(len(self.windows)),
            "estimates that are ok": str(sum(estimate.ok for estimate in self.estimates)),
            "updates sent, applied": f"{len(self.updates)}, {len(self.applied)}",
            "returns to the fallback set": str(len(self.fallbacks)),
            "trend": repr(self.trend),
        }
        return html_table(f"Co-simulation of {self.scenario.name}", rows)

    @property
    def columns(self) -> dict[str, list[Any]]:
        """Estimates as columns, one row per window. Signals are in ``loop.run.columns``."""
        estimates = self.estimates
        return {
            "sequence": [window.sequence for window in self.windows],
            "start_s": [window.start for window in self.windows],
            "time_s": [estimate.time for estimate in estimates],
            "status": [estimate.status.value for estimate in estimates],
            "gap_rad": [estimate.gap for estimate in estimates],
            "gap_low_rad": [estimate.interval[0] for estimate in estimates],
            "gap_high_rad": [estimate.interval[1] for estimate in estimates],
            "trend_gap_rad": [math.nan if trend is None else trend.gap for trend in self.trends],
            "trend_rate_rad_per_s": [math.nan if trend is None else trend.rate for trend in self.trends],
        }

    def to_pandas(self) -> Any:
        """``pandas.DataFrame`` of `columns`, one row per window; ``loop.run.to_pandas()`` holds the signals.

        Raises
        ------
        InvalidInput
            pandas is not installed.
        """
        return pandas_table(self.columns)

    def to_arrow(self) -> Any:
        """``pyarrow.Table`` of `columns`, one row per window; ``loop.run.to_arrow()`` holds the signals.

        Raises
        ------
        InvalidInput
            pyarrow is not installed.
        """
        return arrow_table(self.columns)

    def plot(self) -> Figure:
        """Figure of the run with the estimates of the gap, bars of 95 %.

        Raises
        ------
        InvalidInput
            matplotlib is not installed.
        """
        figure = self.run.plot()
        usable = [estimate for estimate in self.estimates if estimate.ok]
        gaps = np.degrees([estimate.gap for estimate in usable])
        ends = np.degrees([estimate.interval for estimate in usable]).reshape(-1, 2)
        bars = np.maximum(np.stack([gaps - ends[:, 0], ends[:, 1] - gaps]), 0.0)
        axes = figure.axes[2]
        axes.errorbar([e.time for e in usable], gaps, bars, fmt=".", label="estimate, 95 %", linewidth=1.0)
        legend_above(axes)
        figure.suptitle(self._title)
        return figure

    def digest(self) -> str:
        """SHA-256 over every message (bytes, times, fate) and the trajectory: equal only for runs equal bit for bit."""
        total = hashlib.sha256()
        for m in self.messages:
            total.update(
                f"{m.direction} {m.serial} {m.copy} {m.sent!r} {m.arrival!r} {m.fate} {len(m.data)}\n".encode()
            )
            total.update(m.data)
        for name in TRAJECTORY:
            total.update(getattr(self.run, name).tobytes())
        return total.hexdigest()
