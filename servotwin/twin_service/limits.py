"""Limits on what a client may send: message rate and sample time; and the rejection."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from typing import Any, NamedTuple

from servotwin.messages import Refusal

Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
"""ASGI's: the next event of a request."""
MAX_SERVOS = 50_000
"""Servos and boots whose limits are in memory; one that was dropped counts as new."""
_MAX_UPTIME_S = 20.0 * 365.25 * 86400.0
"""s; no edge runs longer without a restart."""

STATUS: Mapping[Refusal, int] = {
    Refusal.NOT_UNDERSTOOD: 400,
    Refusal.UNKNOWN_SCHEMA: 400,
    Refusal.BAD_CHECKSUM: 400,
    Refusal.OTHER_NAME: 400,
    Refusal.BAD_TOKEN: 401,
    Refusal.UNKNOWN_SERVO: 404,
    Refusal.CONFLICT: 409,
    Refusal.SUPERSEDED: 409,
    Refusal.TOO_LARGE: 413,
    Refusal.FUTURE: 422,
    Refusal.TOO_MANY: 429,
    Refusal.UNAVAILABLE: 503,
}
"""HTTP status of each reason."""


class RequestRejected(Exception):
    """Rejection of a request, over any transport.

    Parameters
    ----------
    refusal : Refusal
    detail : str
        One sentence for the sender: no secret, nothing about the service's inside.
    status : int, optional
        Of HTTP; as in `STATUS` by default.
    close : bool
        Close the connection.

    Attributes
    ----------
    mark : str
        `body_mark` of the body that was refused; empty: it was not read.
    """

    def __init__(self, refusal: Refusal, detail: str, status: int | None = None, close: bool = False) -> None:
        super().__init__(detail)
        self.refusal, self.detail, self.close, self.mark = refusal, detail, close, ""
        self.status = STATUS[refusal] if status is None else status


class Disconnected(Exception):
    """The client closed the connection before its body was complete."""


class RateLimiter:
    """Token bucket per servo: a message takes one token or more, `rate` tokens per s are added up to `burst`.

    The least recently used buckets are dropped; a bucket that was dropped is full when it is used again.

    Parameters
    ----------
    rate, burst : float
        Per s; number.
    monotonic : callable
        s.
    counted, owner : str
        What a token stands for, and whom a bucket belongs to, in rejections.
    """

    def __init__(
        self,
        rate: float,
        burst: float,
        monotonic: Callable[[], float],
        counted: str = "messages",
        owner: str = "servo",
    ) -> None:
        self._rate, self._burst, self._now = rate, max(1.0, burst), monotonic
        self._counted, self._owner = counted, owner
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, servo: str, number: float = 1.0) -> None:
        """Take tokens of a servo.

        Raises
        ------
        RequestRejected
            TOO_MANY: the bucket holds fewer, and is not full.
        """
        if not self.admits(servo, number):
            raise RequestRejected(
                Refusal.TOO_MANY, f"more than {self._rate:g} {self._counted} per s of {self._owner} {servo!r}"
            )

    def admits(self, servo: str, number: float = 1.0) -> bool:
        """Take tokens of a servo; False: the bucket holds fewer, and none is taken."""
        now = self._now()
        level, at = self._levels.get(servo, (self._burst, now))
        level = min(self._burst, level + self._rate * (now - at))
        # What is larger than the bucket passes when that is full, or it would never.
        empty = level < min(number, self._burst)
        # A rejected message takes no token: a servo that repeats too fast gets through at the allowed rate.
        self._levels[servo] = (level if empty else level - number), now
        self._levels.move_to_end(servo)
        if len(self._levels) > MAX_SERVOS:
            self._levels.popitem(last=False)
        return not empty

    def give_back(self, servo: str, number: float) -> None:
        """Give tokens back that were taken for nothing."""
        if servo in self._levels:
            level, at = self._levels[servo]
            self._levels[servo] = level + number, at


class _SampleTime(NamedTuple):
    """Sample time (s) that a boot reported, and when (s, monotonic)."""

    at: float
    sample_time: float


class SampleTimeLimiter:
    """Rejects windows from the future: the sample time of a boot passes at most `speed` times as fast as time.

    The first message of a boot gives its sample time. A hello may advance it: it reports the edge's time when it was
    sent, while a window may be old. Once a servo has sent a hello, windows of other boots pass: they are sent again
    faster than they were recorded, after a restore or an outage, and change no setting.

    Parameters
    ----------
    speed : float
        Sample time per time.
    slack : float
        s of sample time allowed beyond that.
    """

    def __init__(self, speed: float, slack: float) -> None:
        self._speed, self._slack = speed, slack
        self._boots: OrderedDict[tuple[str, str], _SampleTime] = OrderedDict()
        self._current: OrderedDict[str, str] = OrderedDict()

    def hello(self, servo: str, boot: str, sample_time: float, now: float) -> None:
        """Note the sample time that an edge reports; raises RequestRejected (FUTURE) where no edge runs that long."""
        _check_possible(sample_time)
        self._current[servo] = boot
        self._current.move_to_end(servo)
        if len(self._current) > MAX_SERVOS:
            self._current.popitem(last=False)
        known = self._boots.get((servo, boot))
        # Forwards only: a hello that was long on its way must not make windows appear early.
        if known is None or sample_time > self._reached(known, now):
            self._note(servo, boot, _SampleTime(now, sample_time))

    def check(self, servo: str, boot: str, end: float, now: float) -> None:
        """Check a window whose last sample was taken at `end` (s of sample time), received at `now` (s).

        Raises
        ------
        RequestRejected
            FUTURE.
        """
        _check_possible(end)
        if self._current.get(servo, boot) != boot:
            return
        known = self._boots.get((servo, boot))
        if known is None:
            self._note(servo, boot, _SampleTime(now, end))
            return
        reached = self._reached(known, now) + self._slack
        if end > reached:
            raise RequestRejected(
                Refusal.FUTURE,
                f"the window ends at {end:.3f} s of sample time; its boot can have reached {reached:.3f} s by now",
            )

    def _reached(self, known: _SampleTime, now: float) -> float:
        return known.sample_time + self._speed * (now - known.at)

    def _note(self, servo: str, boot: str, reported: _SampleTime) -> None:
        self._boots[servo, boot] = reported
        if len(self._boots) > MAX_SERVOS:
            self._boots.popitem(last=False)


def _check_possible(sample_time: float) -> None:
    if sample_time > _MAX_UPTIME_S:
        raise RequestRejected(Refusal.FUTURE, f"sample time {sample_time:.3g} s: no edge runs that long")


def daily_bytes_limiter(megabytes_per_day: float, monotonic: Callable[[], float]) -> RateLimiter | None:
    """Limit of the bytes that a servo stores; a day's worth may come at once, as after an outage. None: no limit."""
    if math.isinf(megabytes_per_day):
        return None
    daily = megabytes_per_day * 1e6
    return RateLimiter(daily / 86400.0, daily, monotonic, "bytes to be stored")
