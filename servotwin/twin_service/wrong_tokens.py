"""Requests with wrong tokens, told together: an edge that is refused again and again, or somebody who tries tokens."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from collections.abc import Callable

log = logging.getLogger(__name__)

_AGAIN = 5
"""Refused requests from which on they are told: an edge sends as many within seconds, and a mistyped token is none."""
_QUIET_S, _LOOK_S = 600.0, 5.0
"""s without such a request after which the count begins anew, longer than any edge waits; s between two looks."""
_NAMED = 5
"""Servos that a sentence names."""


class WrongTokens:
    """Count of the requests that were refused because of the token that they showed.

    Whoever sends them may be a stranger who sends thousands under any names: they are told in one sentence, not more
    often than every `pause` s, which names only servos that have a token.

    Parameters
    ----------
    enrolled : callable
        Test whether a servo of that name has a token.
    pause : float
        s between two alarms, at least ten minutes.
    monotonic : callable
        s.
    """

    def __init__(self, enrolled: Callable[[str], bool], pause: float, monotonic: Callable[[], float]) -> None:
        self._enrolled, self._pause, self._now = enrolled, max(pause, _QUIET_S), monotonic
        self._servos = Counter[str]()
        self._begun = self._last = self._told = -math.inf

    def note(self, servo: str) -> None:
        """Note a refused request, and the servo that it claims to come from; empty: none."""
        now = self._now()
        if now - self._last > _QUIET_S:
            self._servos.clear()
            self._begun = now
        self._last = now
        self._servos[servo if self._enrolled(servo) else ""] += 1

    def sentences(self) -> list[str]:
        """Return a sentence, without names, while such requests come again and again."""
        return [f"{self._counted()}; the log names the servos"] if self._again else []

    @property
    def _again(self) -> bool:
        return self._servos.total() >= _AGAIN and self._now() - self._last <= _QUIET_S

    def _counted(self) -> str:
        minutes = max(1, math.ceil((self._now() - self._begun) / 60.0))
        return f"{self._servos.total()} requests within {minutes} min were refused because of a wrong token"

    def _sentence(self) -> str:
        named = [(servo, number) for servo, number in self._servos.most_common() if servo]
        parts = [f"{number} in the name of {servo}" for servo, number in named[:_NAMED]]
        rest = self._servos.total() - sum(number for _, number in named[:_NAMED])
        parts += [f"{rest} in other names"] if rest else []
        return f"{self._counted()}, {', '.join(parts)}: copy the right token to that edge, or find out who sends them"

    def look(self, announce: Callable[[str, str], None]) -> None:
        """Log and announce the sentence where it is due: after further requests only."""
        if self._again and self._last > self._told and self._now() - self._told >= self._pause:
            self._told = self._now()
            log.warning("wrong tokens", extra={"why": self._sentence()})
            announce("wrong tokens", self._sentence())

    async def watch(self, announce: Callable[[str, str], None]) -> None:
        """Look again and again."""
        while True:
            await asyncio.sleep(_LOOK_S)
            self.look(announce)
