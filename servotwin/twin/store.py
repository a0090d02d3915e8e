"""Where a twin keeps its evidence: window -> estimate -> update -> receipt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from servotwin.identify.estimate import GapEstimate
from servotwin.identify.trend import Trend
from servotwin.messages import Receipt, Update, Window

Identity = tuple[str, str, int]
"""(servo, boot, sequence) of a window."""


class Store(Protocol):
    """What a twin asks of its store. Each call returns only when the thing is safe."""

    def add_window(self, window: Window) -> bool:
        """Keep a window under its identity; False when it was there already."""
        ...

    def add_estimate(self, window: Window, estimate: GapEstimate) -> None:
        """Keep what was estimated from a window."""
        ...

    def add_trend(self, window: Window, trend: Trend | None) -> None:
        """Keep what is known of the wear after a window; None: nothing yet."""
        ...

    def add_update(self, update: Update) -> None:
        """Keep an update before it is sent."""
        ...

    def add_receipt(self, receipt: Receipt) -> None:
        """Keep what the edge says it did."""
        ...


@dataclass
class MemoryStore:
    """A store that forgets with its process; for simulation and tests."""

    windows: dict[Identity, Window] = field(default_factory=dict)
    estimates: dict[Identity, GapEstimate] = field(default_factory=dict)
    trends: dict[Identity, Trend | None] = field(default_factory=dict)
    updates: list[Update] = field(default_factory=list)
    receipts: list[Receipt] = field(default_factory=list)

    def add_window(self, window: Window) -> bool:
        """Keep a window under its identity; False when it was there already."""
        new = window.identity not in self.windows
        self.windows.setdefault(window.identity, window)
        return new

    def add_estimate(self, window: Window, estimate: GapEstimate) -> None:
        """Keep what was estimated from a window."""
        self.estimates[window.identity] = estimate

    def add_trend(self, window: Window, trend: Trend | None) -> None:
        """Keep the trend after a window."""
        self.trends[window.identity] = trend

    def add_update(self, update: Update) -> None:
        """Keep an update."""
        self.updates.append(update)

    def add_receipt(self, receipt: Receipt) -> None:
        """Keep a receipt."""
        self.receipts.append(receipt)
