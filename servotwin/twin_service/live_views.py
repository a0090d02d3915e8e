"""Live views in memory: pages that watch a machine, its edge that waits until one does, and the newest columns."""

from __future__ import annotations

import asyncio
import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from servotwin.messages import InvalidMessage, Refusal
from servotwin.messages.live import COLUMN_S, LiveColumn, LiveColumns, decode_columns
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.limits import MAX_SERVOS, RateLimiter, RequestRejected

WATCHED_S = 5.0
"""s after its last question for which a page still counts as watching."""
_SHOWN_S = 60.0
"""s of columns that are kept of a machine that is watched."""
_STALE_S, _ALLOWED_S = 3.0, 40.0
"""s without a column after which the view is stale; s since the edge was last heard here for which its file counts as
one that allows the view: longer than its longest wait."""
_NOTHING: LiveColumn = (None, None, None, None, None, None)
"""Stands for a column that the edge could not send."""
_RATE, _BURST = 4.0, 12.0
"""Messages of one edge: per s, and at once; it sends two a second."""
_POLLS = 2
"""Edges of one servo that may wait at once: one that was superseded may not have noticed yet."""


@dataclass(slots=True)
class _View:
    """State of a machine that is watched; times in s, monotonic."""

    asked: float
    came: float = -math.inf
    boot: int = 0
    width: float = COLUMN_S
    next: int = 0
    columns: deque[LiveColumn] = field(default_factory=lambda: deque(maxlen=round(_SHOWN_S / COLUMN_S)))

    def holds(self, sent: LiveColumns) -> bool:
        """True where these very columns came before."""
        first = len(self.columns) - (self.next - sent.first)
        held = list(self.columns)[first : first + len(sent.columns)] if first >= 0 else []
        return (sent.boot, sent.width) == (self.boot, self.width) and held == list(sent.columns)


class LiveViews:
    """Views of all machines.

    Parameters
    ----------
    monotonic : callable
        s.
    connected : callable
        True, False or None (not known) for a servo: its edge waits for messages here.
    watched, waiting : int
        Machines that may be watched, and edges that may wait, at once.
    """

    def __init__(
        self,
        monotonic: Callable[[], float],
        connected: Callable[[str], bool | None],
        watched: int,
        waiting: int,
    ) -> None:
        self._now, self._connected, self._most_watched, self._most_waiting = monotonic, connected, watched, waiting
        self._views: dict[str, _View] = {}
        self._edges: OrderedDict[str, float] = OrderedDict()
        self._waiting: dict[str, set[asyncio.Future[None]]] = {}
        self._open = Counter[str]()
        self._closed = False

    def watched(self, servo: str) -> bool:
        """True where a page has asked for the servo a short time ago."""
        view = self._views.get(servo)
        return view is not None and self._now() - view.asked < WATCHED_S

    def look(self, servo: str, boot: int, after: int) -> dict[str, Any]:
        """Answer a page, and keep the edge streaming for `WATCHED_S`.

        Parameters
        ----------
        servo : str
        boot, after : int
            Boot and number of the column that the page has as the newest.

        Returns
        -------
        dict
            Ready for JSON: state (off, away, waiting, live, stale), age of the newest column (s or None), width (s),
            boot, first (number of the first column) and columns, as in `LiveColumns`.

        Raises
        ------
        RequestRejected
            TOO_MANY machines are watched.
        """
        now = self._now()
        self._views = {name: view for name, view in self._views.items() if now - view.asked < WATCHED_S}
        view = self._views.get(servo)
        if view is None:
            if len(self._views) >= self._most_watched:
                raise RequestRejected(Refusal.TOO_MANY, f"{self._most_watched} machines are watched live already")
            view = self._views[servo] = _View(now)
        view.asked = now
        self._wake(servo)
        known = view.next - len(view.columns)
        first = max(known, after + 1) if boot == view.boot and after < view.next else known
        return {
            "state": self._state(servo, view),
            "age": None if math.isinf(view.came) else round(now - view.came, 1),
            "width": view.width,
            "boot": view.boot,
            "first": first,
            "columns": list(view.columns)[first - known :],
        }

    def take(self, servo: str, sent: LiveColumns) -> bool:
        """Take columns of an edge; True while somebody watches, otherwise they are dropped."""
        self._heard(servo)
        view = self._views.get(servo)
        if view is None or not self.watched(servo):
            return False
        if not sent.columns:
            return True
        missing = sent.first - view.next
        if view.holds(sent):  # over a broker an edge sends them again where the answer is late
            return True
        if (sent.boot, sent.width) != (view.boot, view.width) or not 0 <= missing < (view.columns.maxlen or 0):
            view.columns.clear()
        elif view.columns:
            view.columns.extend([_NOTHING] * missing)
        view.columns.extend(sent.columns)
        view.boot, view.width, view.next = sent.boot, sent.width, sent.first + len(sent.columns)
        view.came = self._now()
        return True

    async def wait(self, servo: str, seconds: float) -> bool:
        """Wait until somebody watches a servo; False: nobody did.

        Raises
        ------
        RequestRejected
            TOO_MANY edges wait.
        """
        if self._open.total() >= self._most_waiting or self._open[servo] >= _POLLS:
            raise RequestRejected(Refusal.TOO_MANY, "too many edges wait for a live view already")
        self._open[servo] += 1
        try:
            if not (self.watched(servo) or self._closed):
                await self._sleep(servo, seconds)
        finally:
            self._open[servo] -= 1
            if not self._open[servo]:
                del self._open[servo]
            self._heard(servo)
        return self.watched(servo)

    def close(self) -> None:
        """End every wait now."""
        self._closed = True
        for servo in tuple(self._waiting):
            self._wake(servo)

    def _state(self, servo: str, view: _View) -> str:
        if not math.isinf(view.came):
            return "live" if self._now() - view.came < _STALE_S else "stale"
        allowed = self._open[servo] > 0 or self._now() - self._edges.get(servo, -math.inf) < _ALLOWED_S
        if allowed:
            return "waiting"
        return "away" if self._connected(servo) is False else "off"

    def _heard(self, servo: str) -> None:
        self._edges[servo] = self._now()
        self._edges.move_to_end(servo)
        if len(self._edges) > MAX_SERVOS:
            self._edges.popitem(last=False)

    def _wake(self, servo: str) -> None:
        for waiting in self._waiting.pop(servo, ()):
            if not waiting.done():
                waiting.set_result(None)

    async def _sleep(self, servo: str, seconds: float) -> None:
        woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(servo, set()).add(woken)
        try:
            async with asyncio.timeout(seconds):
                await woken
        except TimeoutError:
            pass
        finally:
            others = self._waiting.get(servo, set())
            others.discard(woken)
            if not others:
                self._waiting.pop(servo, None)


class LiveIntake:
    """Takes what edges send for live views, over HTTP and MQTT; the sender's seal or token is checked before.

    Parameters
    ----------
    claims : EdgeClaims
    views : LiveViews
    monotonic : callable
        s.
    """

    def __init__(self, claims: EdgeClaims, views: LiveViews, monotonic: Callable[[], float]) -> None:
        self._claims, self._views = claims, views
        self._limit = RateLimiter(_RATE, _BURST, monotonic, "live messages")

    async def admit(self, servo: str, claim: str) -> None:
        """Check the rate of an edge and its claim; raises RequestRejected."""
        self._limit.take(servo)
        await self._claims.check(servo, claim)

    async def take(self, servo: str, body: bytes, wait: float) -> bool:
        """Take encoded columns, or wait `wait` s for a watcher where there are none; True while somebody watches.

        Raises
        ------
        RequestRejected
            The bytes are no columns, are another servo's, or too many edges wait.
        """
        try:
            sent = decode_columns(body)
        except InvalidMessage as error:
            raise RequestRejected(error.refusal, str(error)) from None
        if sent.servo != servo:
            raise RequestRejected(Refusal.OTHER_NAME, f"the columns are of servo {sent.servo!r}, not of {servo!r}")
        return self._views.take(servo, sent) if sent.columns else await self._views.wait(servo, wait)
