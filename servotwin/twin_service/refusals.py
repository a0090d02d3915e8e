"""Refused requests: counted, logged, and slowed down where one sender repeats them in a loop."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import time
from collections.abc import Callable
from typing import Any

from servotwin.messages import Refusal
from servotwin.twin_service.limits import RateLimiter
from servotwin.twin_service.monitoring import Metrics, RefusalLog

log = logging.getLogger(__name__)

_PER_S, _AT_ONCE, _SLOW_S = 10.0, 100.0, 1.0
"""Refusals per s of one sender that are answered at once, after so many together; s that any other one takes: whoever
repeats refused requests, with a token or without, would slow all others."""
_SITE = 64
"""Bits of an IPv6 address that name a site: its computers choose the others as they like."""


class Refusals:
    """Refusals of one twin, from whomever and over any transport.

    Parameters
    ----------
    metrics : Metrics
    owner_of : callable
        Name of whose a token is, empty: nobody's.
    wrong_token : callable
        Called with the servo in the path of a request whose token is refused; empty: the path names none.
    monotonic : callable
        s.
    """

    def __init__(
        self,
        metrics: Metrics,
        wrong_token: Callable[[str], None] = lambda _servo: None,
        owner_of: Callable[[bytes | None], str] = lambda _token: "",
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._metrics, self._wrong_token, self._owner_of = metrics, wrong_token, owner_of
        self._lines, self._pace = RefusalLog(log, monotonic), RateLimiter(_PER_S, _AT_ONCE, monotonic)

    def log(self, code: Refusal, servo: str, shown: bool, **about: Any) -> None:
        """Count and log a refusal; `shown`: the request had a token. A page without a session has none, and is no
        attempt."""
        self.count(code)
        self._lines.write(code.value, servo=servo, **about)
        if code is Refusal.BAD_TOKEN and shown:
            self._wrong_token(servo)

    def count(self, code: Refusal) -> None:
        """Count a refusal."""
        self._metrics.rejected.add(code.value)

    def sender(self, token: bytes | None, address: str) -> str:
        """Name the sender of a request: whose its token is, otherwise its address."""
        owner = self._owner_of(token)
        return f"owner {owner}" if owner else f"address {_site(address)}"

    async def hold_back(self, sender: str) -> None:
        """Hold the answer to a refused request back where its sender repeats them in a loop; others are not held."""
        if not self._pace.admits(sender):
            await asyncio.sleep(_SLOW_S)


def _site(address: str) -> str:
    """The address, and of IPv6 the network of its site."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    return str(found.ipv4_mapped or ipaddress.ip_network((found, _SITE), strict=False))
