"""Messages to systemd: the service is ready, alive, or ends (sd_notify(3)); nothing without a service manager."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from math import inf


class ServiceManager:
    """Datagrams to the socket that `NOTIFY_SOCKET` names; a call never blocks, and never raises.

    What the service manager does not take, because its queue is full or it is starting anew, is sent again at the next
    `alive`.

    Parameters
    ----------
    environment : mapping
        As systemd sets it for Type=notify, and for WatchdogSec=.

    Attributes
    ----------
    watchdog_s : float
        s between two `alive` that reach the service manager, half of what it allows; inf: it watches nothing.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        name = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the null byte with which Linux's abstract addresses begin.
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._socket: socket.socket | None = None
        self._due, self._ready_unsent = -inf, False
        self.watchdog_s = _watchdog(environment) / 2.0 if self._address else inf

    def ready(self) -> None:
        """The service has started."""
        self._ready_unsent = not self._send("READY=1")

    def alive(self, now: float) -> None:
        """Tell that the service works, where that is due at `now` (s, monotonic); call it often."""
        if self._ready_unsent:
            self.ready()
        if now >= self._due and self.watchdog_s < inf and self._send("WATCHDOG=1"):
            self._due = now + self.watchdog_s

    def stopping(self) -> None:
        """The service ends."""
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, state: str) -> bool:
        """Send a state; False where the service manager did not take it: the machine's control goes on."""
        if not self._address:
            return True
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
                self._socket.setblocking(False)
            self._socket.sendto(state.encode(), self._address)
        except OSError:
            return False
        return True


def _watchdog(environment: Mapping[str, str]) -> float:
    """Time that the service manager allows between two signs of life, s; inf: it does not ask this process for any."""
    time, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    watched = time.isdecimal() and int(time) > 0 and (not process or process == str(os.getpid()))
    return int(time) * 1e-6 if watched else inf
