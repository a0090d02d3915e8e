"""The link over HTTP: windows by PUT, letters by POST, the twin's messages by long poll; standard library only."""

from __future__ import annotations

import socket
import ssl
import time
from collections.abc import Callable
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from threading import Lock
from urllib.parse import quote, urlsplit

import msgspec

from servotwin.errors import InvalidInput
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.link.url import is_encrypted
from servotwin.messages import MAX_BYTES, Acknowledge, InvalidMessage, Refusal, decode

BODY = "application/msgpack"
LONGEST_PAUSE_S = 300.0
_PIECE = 65536
_ANSWER, _ERROR = 64 * 1024, 8 * 1024


class _RefusalBody(msgspec.Struct, frozen=True):
    """The body of a refusal."""

    code: Refusal
    detail: str = ""


class HttpReply(msgspec.Struct, frozen=True):
    """Status, body and Retry-After of a response."""

    status: int
    body: bytes
    retry_after: str


class HttpLine:
    """One connection, kept open from request to request; opened again when the other side has closed it.

    Parameters
    ----------
    url : str
        http(s)://host[:port][/path].
    token : str
    timeout_s : float
        For one request, with its answer, s.
    context : ssl.SSLContext, optional
        For https.
    clock : callable
        Monotonic, s.
    """

    def __init__(
        self,
        url: str,
        token: str,
        timeout_s: float,
        context: ssl.SSLContext | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._parts, self._timeout, self._context, self._clock = urlsplit(url), timeout_s, context, clock
        self._headers = {"Authorization": f"Bearer {token}", "Accept": BODY}
        self._connection: HTTPConnection | None = None
        self._closed, self._busy = False, Lock()

    def ask(self, method: str, path: str, body: bytes | None, headers: dict[str, str], limit: int) -> HttpReply:
        """One request and its answer, of `limit` bytes at most; raises Unreachable."""
        with self._busy:
            return self._ask(method, path, body, headers, limit)

    def _ask(self, method: str, path: str, body: bytes | None, headers: dict[str, str], limit: int) -> HttpReply:
        fresh = self._connection is None
        try:
            return self._once(method, path, body, headers, limit)
        except (OSError, HTTPException, ValueError) as error:
            self.drop()
            if fresh or isinstance(error, TimeoutError):
                raise Unreachable(f"{type(error).__name__}: {error}") from None
        return self._ask(method, path, body, headers, limit)

    def drop(self) -> None:
        """Close the connection; the next request opens another."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def close(self) -> None:
        """No more requests; the one under way fails at once."""
        self._closed = True
        connection = self._connection
        if self._busy.acquire(blocking=False):
            self.drop()
            self._busy.release()
        elif connection is not None and connection.sock is not None:
            _shut(connection)

    def _once(self, method: str, path: str, body: bytes | None, headers: dict[str, str], limit: int) -> HttpReply:
        connection = self._connection or self._open()
        deadline = self._clock() + self._timeout
        connection.request(method, self._parts.path.rstrip("/") + path, body, {**self._headers, **headers})
        response = connection.getresponse()
        data = self._read(response, limit, deadline)
        answer = HttpReply(response.status, data, response.headers.get("Retry-After", ""))
        if response.will_close:
            self.drop()
        return answer

    def _open(self) -> HTTPConnection:
        if self._closed:
            raise Unreachable("the link is closed")
        host, port = self._parts.hostname or "", self._parts.port
        if self._context is None:
            self._connection = HTTPConnection(host, port, timeout=self._timeout)
        else:
            self._connection = HTTPSConnection(host, port, timeout=self._timeout, context=self._context)
        return self._connection

    def _read(self, response: HTTPResponse, limit: int, deadline: float) -> bytes:
        """The body; a server that sends too much, or byte by byte, is left."""
        pieces: list[bytes] = []
        size = 0
        while piece := response.read1(_PIECE):
            size += len(piece)
            if size > limit:
                raise HTTPException(f"an answer of more than {limit} bytes")
            if self._clock() > deadline:
                raise TimeoutError("the answer takes too long")
            pieces.append(piece)
        response.close()  # all of it is read: the connection is free for the next request
        return b"".join(pieces)


class HttpTransport:
    """One servo's link to a twin.

    Parameters
    ----------
    url : str
        http(s)://host[:port][/path].
    servo, token : str
    ca_file : str, optional
        Certificates that the twin's is checked against; None: the system's.
    timeout_s : float
        For an answer, s.
    wait_s : float
        How long one poll waits, s.
    """

    def __init__(
        self,
        url: str,
        servo: str,
        token: str,
        ca_file: str | None = None,
        timeout_s: float = 10.0,
        wait_s: float = 25.0,
    ) -> None:
        context = _context(ca_file) if is_encrypted(url) else None
        self._base, self._wait = f"/v1/servos/{quote(servo, safe='')}", wait_s
        self._up = HttpLine(url, token, timeout_s, context)
        self._down = HttpLine(url, token, timeout_s + wait_s, context)

    def deliver(self, parcel: Parcel) -> None:
        """Return when the twin has the message safe; see `Transport`."""
        headers = {"Content-Type": BODY}
        if parcel.encoding:
            headers["Content-Encoding"] = parcel.encoding
        if not parcel.is_window:
            _checked(self._up.ask("POST", f"{self._base}/letters", parcel.body, headers, _ANSWER), (200, 202))
            return
        path = f"{self._base}/windows/{quote(parcel.boot, safe='')}/{parcel.sequence}"
        answer = _checked(self._up.ask("PUT", path, parcel.body, headers, _ANSWER), (200, 201))
        expected = Acknowledge(parcel.servo, parcel.boot, parcel.sequence)
        if not any(_is(expected, data) for data in _listed(answer.body)):
            raise Unreachable("the answer to a window does not acknowledge it: whoever answers is not the twin")

    def listen(self, after: int) -> list[bytes]:
        """The twin's messages with serials above `after`; see `Transport`."""
        path = f"{self._base}/outgoing?after={after}&wait={self._wait:g}"
        return _listed(_checked(self._down.ask("GET", path, None, {}, 4 * MAX_BYTES), (200,)).body)

    def close(self) -> None:
        """Let go of both connections."""
        self._up.close()
        self._down.close()


def _context(ca_file: str | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        raise InvalidInput(f"{ca_file}: holds no certificates that can be read ({error})") from None


def _shut(connection: HTTPConnection) -> None:
    """Wake whoever waits for an answer on it."""
    try:
        connection.sock.shutdown(socket.SHUT_RDWR)
    except OSError:
        return


def _checked(answer: HttpReply, good: tuple[int, ...]) -> HttpReply:
    """The answer, if it is a good one.

    Only a reason code of the twin's own refuses a message; whatever else stands in between makes it unreachable.
    """
    if answer.status in good:
        return answer
    try:
        said = msgspec.json.decode(answer.body[:_ERROR], type=_RefusalBody)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        raise Unreachable(f"HTTP status {answer.status}, without a reason code of the twin's") from None
    raise Refused(said.code, said.detail[:200], _seconds(answer.retry_after))


def _seconds(text: str) -> float:
    """Of a Retry-After header; 0 where it says nothing useful."""
    return min(float(text), LONGEST_PAUSE_S) if text.isascii() and text.isdigit() else 0.0


def _listed(body: bytes) -> list[bytes]:
    try:
        return msgspec.msgpack.decode(body, type=list[bytes])
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise Unreachable("the answer is not a list of messages: whoever answers is not the twin") from None


def _is(expected: Acknowledge, data: bytes) -> bool:
    try:
        return decode(data) == expected
    except InvalidMessage:
        return False
