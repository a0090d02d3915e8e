"""Which parameters the edge runs, which are on their way, and what may be sent next."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec

from servotwin.messages import Reason, Receipt, Update, Window

EARLIER = 1000
"""Boots that a twin remembers, so that what it remembers is bounded."""


@dataclass
class Versions:
    """The twin's view of one edge's parameter versions.

    Version numbers only rise. The edge swaps a version only for one that names it as its base; when the twin's view
    was out of date, the receipt says what is in force and the same parameters go out again on that base. Within a boot
    of the edge, parameters only move forward in the time of their window; a window of an earlier boot never sets any.

    Attributes
    ----------
    boot : str or None
        The edge's current boot; None: nothing was heard yet.
    in_force : int
        Newest version known to run at the edge.
    issued : int
        Highest version ever given out.
    pending : Update or None
        The newest update, while no receipt for it has come.
    newest : float
        Data time of the newest update of this boot, s.
    earlier : list of str
        Boots that are over, the last `EARLIER` of them.
    root : int
        First of the updates that follow on one another, the pending one last: it stands on what was in force.
    """

    boot: str | None = None
    in_force: int = 0
    issued: int = 0
    pending: Update | None = None
    newest: float = -math.inf
    earlier: list[str] = field(default_factory=list)
    root: int = 0

    def hear(self, boot: str, in_force: int) -> bool:
        """Note what a message says about its boot; False when that boot is over."""
        if boot in self.earlier:
            return False
        if boot != self.boot:
            self._begin(boot, in_force)
        self.in_force = max(self.in_force, in_force)
        self.issued = max(self.issued, self.in_force)
        return True

    def admits(self, window: Window) -> bool:
        """Whether parameters that stand on this window would be newer than all before."""
        return window.boot == self.boot and window.start > self.newest

    def issue(self, update: Update) -> Update:
        """The update under the next version, on the version that the edge will run when it arrives."""
        return self._anew(update) if self.pending is None else self._number(update, self.pending.version)

    def settle(self, receipt: Receipt) -> Update | None:
        """Note a receipt; the update to send instead when the pending one was refused for its base or number, or will
        be, as one that it follows on was refused."""
        if not self.hear(receipt.boot, receipt.parameter_version) or self.pending is None:
            return None
        if self._breaks(receipt):
            return self._anew(self.pending)
        if receipt.version != self.pending.version or receipt.reason is Reason.TOO_SOON:
            return None
        refused, self.pending = self.pending, None
        if receipt.reason is Reason.BASE_MISMATCH or self.in_force > refused.version:
            return self._anew(refused)
        return None

    @property
    def running(self) -> tuple[int, ...]:
        """What is in force, and what is on its way."""
        return self.in_force, *(() if self.pending is None else (self.pending.version,))

    def give_up(self) -> None:
        """Stop waiting for a receipt."""
        self.pending = None

    def _begin(self, boot: str, in_force: int) -> None:
        if self.boot is not None:
            self.earlier = [*self.earlier, self.boot][-EARLIER:]
        self.boot, self.in_force = boot, in_force
        self.pending, self.newest = None, -math.inf

    def _breaks(self, receipt: Receipt) -> bool:
        """Whether the pending update stands on one that will never be in force.

        A twin that is behind issues one update after the other before it reads the first receipt: were only the last
        one's receipt to count, the edge would refuse all of them until the twin has caught up.
        """
        assert self.pending is not None
        follows = self.root <= receipt.version < self.pending.version and self.in_force < self.pending.base_version
        return follows and not receipt.applied and receipt.reason is not Reason.SUPERSEDED

    def _anew(self, update: Update) -> Update:
        """On what is in force."""
        found = self._number(update, self.in_force)
        self.root = found.version
        return found

    def _number(self, update: Update, base: int) -> Update:
        self.issued += 1
        self.newest = update.data_time
        self.pending = msgspec.structs.replace(update, version=self.issued, base_version=base)
        return self.pending
