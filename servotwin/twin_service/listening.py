"""The listening socket, and the descriptors that the process may have."""

from __future__ import annotations

import errno
import logging
import math
import os
import resource
import socket
import time
from contextlib import closing, suppress
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.twin_service.config import ServiceConfig

log = logging.getLogger(__name__)

BACKLOG = 2048
"""Connections that wait to be accepted: after an outage all edges connect at once."""
_RESERVE = 64
"""Descriptors at most, of a quarter of those that the process may have, that no connection takes: the store, the logs
and the workers open files too, and without a reserve the last spare descriptor is soon theirs."""
_TOLD_S = 60.0
"""s between two lines about connections for which there was no descriptor."""


class _Listener(socket.socket):
    """Listening socket that closes a new connection at once where the process has no descriptor left for it.

    asyncio would leave it to wait, and try again 2048 times a second, with a line in the log for each. Descriptors are
    given out lowest first, so that the number of a connection's own says how many are left.
    """

    _spare: int | None = None
    _refused, _told = 0, -math.inf

    def accept(self) -> tuple[socket.socket, Any]:
        if self._spare is None:
            with suppress(OSError):
                self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        try:
            connection, address = super().accept()
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            self._free_spare()
            with suppress(OSError), closing(super().accept()[0]):
                self._note()
            raise BlockingIOError from None
        most = most_descriptors()
        if connection.fileno() < most - min(_RESERVE, most // 4):
            return connection, address
        with closing(connection):
            self._note()
        raise BlockingIOError

    def close(self) -> None:
        self._free_spare()
        super().close()

    def _free_spare(self) -> None:
        if self._spare is not None:
            os.close(self._spare)
            self._spare = None

    def _note(self) -> None:
        self._refused += 1
        if (now := time.monotonic()) >= self._told + _TOLD_S:
            log.error("connections closed: no descriptor left", extra={"number": self._refused})
            self._told = now


def listening_socket(config: ServiceConfig, port: int | None = None) -> socket.socket:
    """Open a socket that listens at the service's address.

    Raises
    ------
    InvalidInput
        The address is in use, or does not belong to this machine.
    """
    where = config.bind, config.port if port is None else port
    family = socket.AF_INET6 if ":" in config.bind else socket.AF_INET
    # The protocol is named: asyncio sets TCP_NODELAY only on sockets that say TCP; without it responses take 50 ms.
    listener = _Listener(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(BACKLOG)
        return listener
    except OSError as error:
        listener.close()
        raise InvalidInput(f"bind = {where[0]!r}, port = {where[1]}: cannot listen there ({error.strerror})") from None


def raise_descriptor_limit() -> None:
    """Allow as many connections as the system grants one process."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def most_descriptors() -> int:
    """Number of descriptors that the system grants this process."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]
