"""Serials of requests over a broker, so that one that comes again is recognised: repeated by the broker, or replayed.

Every link of an edge counts its requests from a random serial on and sends none of them twice: what has no answer goes
again under the next serial.
"""

from __future__ import annotations

from dataclasses import dataclass

_WINDOW = 1024
"""Serials behind the highest one of a link that may still come: packets on their way overtake each other."""
_NEAR = 2**24
"""Serials of one link lie closer than this to each other; of two links with random serials of 52 bits hardly ever."""
_LINKS = 32
"""Links of a servo that are remembered, those in use; an edge has two, and others after each start."""


@dataclass(slots=True)
class _Link:
    """Highest serial of a link; bit k of `seen`: the k-th one below it has come."""

    run: str
    highest: int
    seen: int = 1

    def take(self, serial: int) -> bool:
        """Note a serial; False: it has come before, or is too old."""
        ahead = serial - self.highest
        if ahead > 0:
            self.seen = ((self.seen << min(ahead, _WINDOW)) | 1) & ((1 << _WINDOW) - 1)
            self.highest = serial
            return True
        if -ahead >= _WINDOW or self.seen >> -ahead & 1:
            return False
        self.seen |= 1 << -ahead
        return True


class RequestSerials:
    """Latest serials of each servo's links."""

    def __init__(self) -> None:
        self._links: dict[str, list[_Link]] = {}

    def is_new(self, servo: str, run: str, serial: int) -> bool:
        """Note a request whose seal is intact; False: it has come before.

        Parameters
        ----------
        servo : str
        run : str
            Run of the edge that has made it; empty: not known.
        serial : int
        """
        links = self._links.setdefault(servo, [])
        for place, link in enumerate(links):
            if link.run == run and abs(serial - link.highest) < _NEAR:
                links.insert(0, links.pop(place))
                return link.take(serial)
        links.insert(0, _Link(run, serial))
        del links[_LINKS:]
        return True
