"""The service's end of the link over MQTT 5: one of a group of twins among whom the broker divides what edges ask."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from uuid import uuid4

from servotwin.link.broker import Broker, Connection, Events, Wanted
from servotwin.link.exchange import GONE, UP, Asked, Listen, down, servo_of
from servotwin.twin_service.broker_desk import Desk

log = logging.getLogger(__name__)

SESSION_S = 0
"""Otherwise the broker would go on giving its share to a twin that is gone; now edges hear of it and ask again."""
RECEIVE = 1000
"""Questions under way to one twin."""
ANSWER_S = 60.0
"""An answer that nobody fetched is worth nothing after that: the question has been asked again."""


class Bridge:
    """Takes questions from a broker, and acknowledges each to it only when it is answered for good.

    Parameters
    ----------
    broker : Broker
    desk : Desk
    group : str
        Twins of one group share the questions.
    """

    def __init__(self, broker: Broker, desk: Desk, group: str) -> None:
        self._broker, self._desk, self._group = broker, desk, group
        self._tasks: set[asyncio.Task[None]] = set()
        self._connection: Connection | None = None
        self.connected = False

    async def begin(self) -> None:
        """Connect, and stay connected."""
        loop = asyncio.get_running_loop()

        def message(topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
            loop.call_soon_threadsafe(self._take, topic, payload, acknowledge)

        wanted = Wanted(f"servotwin-{uuid4().hex}", (f"$share/{self._group}/{UP}",), SESSION_S, RECEIVE, GONE)
        self._connection = Connection(self._broker, wanted, Events(message, self._ready, self._lost))

    async def end(self) -> None:
        """Take nothing more, answer what was asked, let go."""
        connection, self._connection = self._connection, None
        while self._tasks:
            await asyncio.wait(self._tasks)
        if connection is not None:
            await asyncio.to_thread(connection.close)

    def _take(self, topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        """What came, on the event loop; unacknowledged where it is not taken, so that another twin gets it."""
        servo = servo_of(topic)
        if servo is None or self._connection is None:
            return
        task = asyncio.create_task(self._serve(self._connection, servo, payload, acknowledge))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: Connection, servo: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        asked = self._desk.read(servo, payload)
        polls = isinstance(asked, Asked) and isinstance(asked.question, Listen)
        if polls:
            acknowledge()  # it waits for news, and must not keep others from being asked meanwhile
        try:
            said = await self._desk.answer(asked) if isinstance(asked, Asked) else asked
        except Exception:
            log.exception("question not answered", extra={"servo": servo})
            said = None
        if not polls:
            acknowledge()
        if said is not None and connection.publish(down(servo), said, ANSWER_S) is None:
            log.warning("answer not sent: too much waits for the broker", extra={"servo": servo})

    def _ready(self, _forgotten: bool) -> None:
        self.connected = True
        log.info("broker connected", extra={"broker": self._broker.url, "group": self._group})

    def _lost(self, why: str) -> None:
        if self.connected:
            log.warning("broker lost", extra={"broker": self._broker.url, "why": why})
        self.connected = False
