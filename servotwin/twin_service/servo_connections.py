"""Connections of each servo: where it has too many, its oldest one is closed."""

from __future__ import annotations

from collections.abc import Callable


class ServoConnections:
    """Open connections that have shown the token of a servo.

    An edge has up to three. Those of a cut line stay open for a while, and a stolen token must not use up the
    descriptors of the service; so the oldest one goes, never the newest.

    Parameters
    ----------
    most : int
        Connections of one servo.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._of: dict[str, dict[object, Callable[[], None]]] = {}

    def enter(self, servo: str, connection: object, close: Callable[[], None]) -> None:
        """Count a connection; `close` closes it."""
        own = self._of.setdefault(servo, {})
        own[connection] = close
        if len(own) > self._most:
            oldest = next(iter(own))
            own.pop(oldest)()

    def leave(self, servo: str, connection: object) -> None:
        """Count a connection no longer, if it still counts."""
        own = self._of.get(servo, {})
        own.pop(connection, None)
        if not own:
            self._of.pop(servo, None)
