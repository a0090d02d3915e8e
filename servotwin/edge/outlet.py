"""Where the agent's cut windows go: the protocol, and the outlet that packs, keeps and repeats them in this process.

The gateway's outlet hands them to a process of its own instead, so that neither packing nor the disk delays a sample.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol

from servotwin.edge.cut import Cut
from servotwin.edge.packing import is_finite, pack
from servotwin.edge.settings import AgentSettings
from servotwin.edge.window_filter import WindowFilter
from servotwin.link.outbox import MemoryOutbox, Outbox
from servotwin.link.session import Sender
from servotwin.messages import Acknowledge, InvalidMessage, Window

NOT_FINITE = "sample not finite"
WITHHELD = "nothing new"


class Outlet(Protocol):
    """What the agent needs of whoever sends its windows; times are sample times, s."""

    @property
    def next_time(self) -> float | None:
        """When something is due next; None: never, or not known here."""

    @property
    def waiting(self) -> bool:
        """Whether the twin owes the acknowledgement of a window."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows that will never be sent (again) without having been acknowledged, by reason."""

    def offer(self, cut: Cut, now: float) -> None:
        """Take charge of what was cut."""

    def due(self, now: float) -> list[Window]:
        """The windows that the agent is to send now, oldest first."""

    def acknowledged(self, message: Acknowledge) -> bool:
        """The twin has a window of this servo; False when that was known."""


class PackingOutlet:
    """Packs at once, keeps in an outbox, repeats until acknowledged.

    Parameters
    ----------
    settings : AgentSettings
    outbox : Outbox, optional
        In memory by default; what it already holds is due at once.
    """

    def __init__(self, settings: AgentSettings, outbox: Outbox | None = None) -> None:
        self._settings = settings
        self._filter: WindowFilter | None = None if settings.window_filter is None else settings.window_filter.start()
        self.outbox = MemoryOutbox() if outbox is None else outbox
        self._sender = Sender(self.outbox, settings.retry)
        self._lost: Counter[str] = Counter()

    @property
    def next_time(self) -> float | None:
        """When a window is due next, s; None: everything is acknowledged or dropped."""
        return self._sender.next_time

    @property
    def waiting(self) -> bool:
        """Whether the twin owes the acknowledgement of a window."""
        return bool(self.outbox.pending())

    @property
    def dropped(self) -> Counter[str]:
        """Windows that will never be sent (again) without having been acknowledged, by reason."""
        return self._lost + Counter(self.outbox.dropped)

    def offer(self, cut: Cut, now: float) -> None:
        """Judge, pack and keep; one that holds a sample which is not finite is counted only."""
        wanted = cut if self._filter is None or not is_finite(cut) else self._filter(cut)
        if wanted is None:
            self._lost[WITHHELD] += 1
            return
        try:
            window = pack(wanted, self._settings)
        except InvalidMessage:
            self._lost[NOT_FINITE] += 1
        else:
            self._sender.offer(window, now)

    def due(self, now: float) -> list[Window]:
        """The windows to send now, oldest first; each counts as sent."""
        return self._sender.due(now)

    def acknowledged(self, message: Acknowledge) -> bool:
        """The twin has a window; False when that was known."""
        return self._sender.acknowledged(message)
