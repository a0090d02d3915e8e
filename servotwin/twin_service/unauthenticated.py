"""Connections that have shown no valid token and no session: bounded in all, and from each address."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

from servotwin.twin_service.auth import AccessControl, bearer_token
from servotwin.twin_service.config import ServiceConfig
from servotwin.twin_service.http_messages import cookie_of
from servotwin.twin_service.listening import most_descriptors
from servotwin.twin_service.servo_connections import ServoConnections
from servotwin.twin_service.sessions import COOKIE, OperatorAccess

_GRACE_S = 2.0
"""s in which a client shows its token: after an outage all edges of a network connect at once, from one address."""


class UnauthenticatedLimit:
    """Limit of the connections that have shown neither a valid token nor the cookie of a session.

    Parameters
    ----------
    access : AccessControl
    operators : OperatorAccess
    most, per_address : int
        Connections in all, of which one address may have half; and from one address, of those that are older than a
        grace period.
    of_servos : ServoConnections
        Counts those that have shown a servo's token.
    """

    def __init__(
        self,
        access: AccessControl,
        operators: OperatorAccess,
        most: int,
        per_address: int,
        of_servos: ServoConnections,
    ) -> None:
        self._access, self._operators, self._most, self._per_address = access, operators, most, per_address
        self._of = Counter[str]()
        self.of_servos = of_servos

    @classmethod
    def of(cls, config: ServiceConfig, access: AccessControl, operators: OperatorAccess) -> UnauthenticatedLimit | None:
        """Limit of a service; None where nobody has a token, or where a proxy shares connections among clients."""
        if config.tokens is None or config.behind_proxy:
            return None
        of_servos = ServoConnections(config.connections_per_servo)
        # A third of the descriptors at most, and another one of TLS handshakes: the rest is for edges and the store.
        most = min(config.unauthenticated_connections, max(1, most_descriptors() // 3))
        per_address = config.unauthenticated_per_address
        return cls(access, operators, most, per_address, of_servos)

    @property
    def open(self) -> int:
        """Number of these connections."""
        return self._of.total()

    def enter(self, address: str, close: Callable[[], None]) -> UnauthenticatedConnection | None:
        """Count a new connection; None: there are too many, in all or from its address, and it has to be closed."""
        # Half of the places at most, also within the grace period: one address must not shut all others out.
        if self.open >= self._most or self._of[address] >= max(1, self._most // 2):
            return None
        self._of[address] += 1
        return UnauthenticatedConnection(self, address, close)

    def leave(self, address: str) -> None:
        """Count a connection no longer."""
        self._of[address] -= 1
        if not self._of[address]:
            del self._of[address]

    def exceeded(self, address: str) -> bool:
        """Test whether an address has more connections than it may."""
        return self._of[address] > self._per_address

    def knows(self, authorization: bytes | None, cookies: bytes | None) -> bool:
        """Test whether these headers of a request hold a servo's or an operator's token, or an operator's session."""
        if authorization is not None:
            return self._access.knows(bearer_token(authorization))
        session = cookie_of(cookies, COOKIE)
        return session is not None and self._operators.session_name(session) is not None

    def servo_of(self, authorization: bytes | None) -> str:
        """Name of the servo whose token this header holds; empty: it is none's."""
        return "" if authorization is None else self._access.servo_of(bearer_token(authorization))


class UnauthenticatedConnection:
    """One connection, until it shows a token or a session, or ends; with a servo's token it counts for that servo.

    Parameters
    ----------
    limit : UnauthenticatedLimit
    address : str
    close : callable
        Closes the connection.
    """

    def __init__(self, limit: UnauthenticatedLimit, address: str, close: Callable[[], None]) -> None:
        self._limit, self._address, self._close = limit, address, close
        self._counted, self._servo = True, ""
        self._timer = asyncio.get_running_loop().call_later(_GRACE_S, self._check)

    def show(self, authorization: bytes | None, cookies: bytes | None) -> None:
        """Note two headers of a request."""
        if not self._counted or not self._limit.knows(authorization, cookies):
            return
        self._leave()
        if servo := self._limit.servo_of(authorization):
            self._servo = servo
            self._limit.of_servos.enter(servo, self, self._close)

    def end(self) -> None:
        """End: the connection is closed."""
        self._leave()
        if self._servo:
            self._limit.of_servos.leave(self._servo, self)

    def _leave(self) -> None:
        if self._counted:
            self._counted = False
            self._timer.cancel()
            self._limit.leave(self._address)

    def _check(self) -> None:
        if self._limit.exceeded(self._address):
            # It counts no longer at once: others that are checked in the same moment would go too.
            self._leave()
            self._close()
