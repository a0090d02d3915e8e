"""Sessions of browsers: an operator's token is given once, and a cookie that cannot be read by scripts follows from it.

The cookie holds the operator's name, an end and a message authentication code under the digest of the token. So no
session is stored, a restart of the twin ends none, and a token that is revoked ends all of its own.
"""

from __future__ import annotations

import hmac
import math
import re
from collections.abc import Callable
from hashlib import sha256

from servotwin.messages import Refusal
from servotwin.twin_service.auth import AccessControl
from servotwin.twin_service.http_messages import HttpRequest
from servotwin.twin_service.limits import RequestRejected

COOKIE = "servotwin-operator"
SESSION_S = 12 * 3600.0
"""s after which a browser has to give the token again."""
_COOKIE = re.compile(r"([0-9a-f]{2,256})\.(\d{1,12})\.([0-9a-f]{64})")
_LABEL = b"servotwin operator session 1\0"
_NO_ENGINEER = "only an engineer's token may do this: `servotwin enroll NAME --engineer FILE` makes one"
_NO_TOKENS = "this twin has no tokens, so that nobody could tell who did it: `servotwin enroll` makes them"
_ENDED = "the session has ended, or its token was revoked: give the token again"


class OperatorAccess:
    """Admits operators by their token, or by the cookie of a session.

    Parameters
    ----------
    access : AccessControl
    wall : callable
        s since the epoch.
    secure : bool
        The cookie is sent over TLS only.
    """

    def __init__(self, access: AccessControl, wall: Callable[[], float], secure: bool) -> None:
        self._access, self._wall, self._secure = access, wall, secure

    @property
    def open(self) -> bool:
        """True where no tokens are configured."""
        return self._access.open

    def check(self, request: HttpRequest) -> str:
        """Check that a request is an operator's, and return the operator's name; raises RequestRejected.

        The name is empty where no tokens are configured.
        """
        cookie = None if request.token is not None else request.cookie(COOKIE)
        if self._access.open:
            return ""
        if cookie is None:
            self._access.check_operator(request.token)
            return self._access.operator_of(request.token)
        name = self.session_name(cookie)
        if name is None:
            raise RequestRejected(Refusal.BAD_TOKEN, _ENDED, 401)
        return name

    def may_act(self, name: str) -> bool:
        """True for the name of an engineer."""
        return self._access.is_engineer(name)

    def check_engineer(self, request: HttpRequest) -> str:
        """Check that a request is an engineer's, and return the engineer's name; raises RequestRejected."""
        name = self.check(request)
        if not self.may_act(name):
            raise RequestRejected(Refusal.BAD_TOKEN, _NO_ENGINEER if name else _NO_TOKENS, 403)
        return name

    def session_cookie(self, token: bytes) -> str:
        """Set-Cookie header of a new session; raises RequestRejected where the token is no operator's."""
        self._access.check_operator(token)
        name = self._access.operator_of(token)
        end = str(math.ceil(self._wall() + SESSION_S))
        encoded = name.encode().hex()
        return self._header(f"{encoded}.{end}.{self._code(name, end)}", SESSION_S)

    def ended_cookie(self) -> str:
        """Set-Cookie header that ends a session."""
        return self._header("", 0.0)

    def session_name(self, cookie: str) -> str | None:
        """Name of the operator whose session a cookie holds; None: it holds none."""
        match = _COOKIE.fullmatch(cookie)
        if match is None:
            return None
        try:
            name = bytes.fromhex(match[1]).decode()
        except ValueError:
            return None
        valid = hmac.compare_digest(self._code(name, match[2]), match[3]) and self._wall() < int(match[2])
        return name if valid else None

    def _code(self, name: str, end: str) -> str:
        """Authentication code; of an operator that does not exist, one that nobody knows."""
        key = self._access.operator_key(name)
        return hmac.digest(key, _LABEL + f"{name}\0{end}".encode(), sha256).hex()

    def _header(self, value: str, seconds: float) -> str:
        secure = "; Secure" if self._secure else ""
        return f"{COOKIE}={value}; Path=/; Max-Age={seconds:.0f}; HttpOnly; SameSite=Strict{secure}"
