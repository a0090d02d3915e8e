"""The link over HTTP: windows by PUT, letters by POST, the twin's messages by long poll; standard library only."""

from __future__ import annotations

from urllib.parse import quote

import msgspec

from servotwin.link.body_mark import body_mark
from servotwin.link.claim import HeldClaim
from servotwin.link.http_connection import HttpAnswer, PersistentConnection
from servotwin.link.transport import LONGEST_OLDER_PAUSE_S, Parcel, Refused, Unreachable
from servotwin.messages import MAX_BYTES, Acknowledge, ClaimStatus, EdgeClaim, InvalidMessage, Refusal, decode, encode
from servotwin.messages.live import LiveColumns, decode_watched, encode_live

BODY = "application/msgpack"
CLAIM = "Servotwin-Claim"
"""Header that names the sender's claim."""
WAITING, OLDER_PAUSE = "Servotwin-Waiting", "Servotwin-Older-Pause"
"""Headers of a window: number of windows that its edge has to send beside it; of the answer: pause before older ones,
s. A version that does not know them ignores them."""
_LONGEST_PAUSE_S = 300.0
"""A longer Retry-After is cut to this."""
_NO_ADDRESS = 404, 405
"""Statuses of a twin that knows no such path, or not that method: it has judged no message."""
_MARKS = 5
"""Protocol from which on a twin tells which body came."""
_OTHER_BODY = "the answer is not to this message as it was sent: a proxy on the way changes it, or swaps answers"
_LONGEST_RESPONSE, _LONGEST_ERROR = 64 * 1024, 8 * 1024
"""Bytes of a response to a message, and of an error, that are read."""


class _RefusalBody(msgspec.Struct, frozen=True):
    """Body of a refusal."""

    code: Refusal
    detail: str = ""
    mark: str = ""


class LiveHttp:
    """Live view of one servo: columns to the twin, and its word whether somebody watches; over a connection of its own.

    Parameters
    ----------
    url, servo, token, ca_file, timeout_s, wait_s
        As of `HttpTransport`.
    """

    def __init__(
        self, url: str, servo: str, token: str, ca_file: str | None, timeout_s: float = 10.0, wait_s: float = 25.0
    ) -> None:
        self._path, self._wait = f"/v1/servos/{quote(servo, safe='')}/live", wait_s
        self._connection = PersistentConnection(url, _headers(token), timeout_s + wait_s, ca_file)

    def send(self, columns: LiveColumns, claim: HeldClaim) -> bool:
        """Send columns; without any, wait until somebody watches. Return True while somebody does.

        Raises
        ------
        Refused, Unreachable
            Refused with UNKNOWN_SCHEMA: the twin is of a version without the live view.
        """
        headers = {"Content-Type": BODY, **_claimed(claim)}
        path = self._path if columns.columns else f"{self._path}?wait={self._wait:g}"
        response = self._connection.request("POST", path, encode_live(columns), headers, _LONGEST_RESPONSE)
        if response.status == 404 and _refusal_of(response) is Refusal.NOT_UNDERSTOOD:
            raise Refused(Refusal.UNKNOWN_SCHEMA, "the twin is of a version without the live view")
        try:
            return decode_watched(_checked(response, (200,)).body).watched
        except InvalidMessage:
            raise Unreachable("the answer to a live view is none: whoever answers is not the twin") from None

    def close(self) -> None:
        """Close the connection; the request under way fails at once."""
        self._connection.close()


class HttpTransport:
    """One servo's link to a twin.

    Parameters
    ----------
    url : str
        http(s)://host[:port][/path].
    servo, token : str
    ca_file : str, optional
        File of the certificates that the twin's is checked against; None: the system's.
    timeout_s : float
        Time limit of a response, s.
    wait_s : float
        Time for which one poll waits for a message, s.
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
        self._base, self._wait = f"/v1/servos/{quote(servo, safe='')}", wait_s
        self.claim = HeldClaim()
        self._twin_marks = False
        self._up = PersistentConnection(url, _headers(token), timeout_s, ca_file)
        self._down = PersistentConnection(url, _headers(token), timeout_s + wait_s, ca_file)

    def deliver(self, parcel: Parcel) -> float:
        """Return when the twin has the message safe; see `Transport`."""
        with self._up.in_step():
            return self._deliver(parcel)

    def _deliver(self, parcel: Parcel) -> float:
        headers = {"Content-Type": BODY, **_claimed(self.claim)}
        if parcel.encoding:
            headers["Content-Encoding"] = parcel.encoding
        mark = body_mark(parcel.body, parcel.encoding) if self._twin_marks else None
        if not parcel.is_window:
            path = f"{self._base}/letters"
            response = _checked(self._up.request("POST", path, parcel.body, headers, _LONGEST_RESPONSE), (202,), mark)
            if mark is not None and _decode_list(response.body) != [mark.encode()]:
                raise Unreachable(_OTHER_BODY)
            return 0.0
        if parcel.waiting:
            headers[WAITING] = str(parcel.waiting)
        path = f"{self._base}/windows/{quote(parcel.boot, safe='')}/{parcel.sequence}"
        response = _checked(self._up.request("PUT", path, parcel.body, headers, _LONGEST_RESPONSE), (200, 201), mark)
        expected = Acknowledge(parcel.servo, parcel.boot, parcel.sequence)
        # A proxy's login page has status 200 too: only the acknowledgement itself counts.
        if not any(_is(expected, data) for data in _decode_list(response.body)):
            raise Unreachable("the answer to a window does not acknowledge it: whoever answers is not the twin")
        return _older_pause_s(response.headers.get(OLDER_PAUSE, ""))

    def listen(self, after: int, at_once: bool = False) -> list[bytes]:
        """Return the twin's messages with serials above `after`; see `Transport`."""
        path = f"{self._base}/outgoing?after={after}&wait={0.0 if at_once else self._wait:g}"
        with self._down.in_step():
            response = self._down.request("GET", path, None, _claimed(self.claim), 4 * MAX_BYTES)
            return _decode_list(_checked(response, (200,)).body)

    def ask(self, claim: EdgeClaim) -> ClaimStatus | None:
        """Send a question or a claim; see `ClaimingTransport`."""
        with self._up.in_step():
            return self._ask(claim)

    def _ask(self, claim: EdgeClaim) -> ClaimStatus | None:
        headers = {"Content-Type": BODY}
        response = self._up.request("POST", f"{self._base}/claim", encode(claim), headers, _LONGEST_RESPONSE)
        if response.status == 404 and _refusal_of(response) is Refusal.NOT_UNDERSTOOD:
            return None  # a twin of a version without claims has no such path
        try:
            status = decode(_checked(response, (200,)).body)
        except InvalidMessage:
            status = None
        if not isinstance(status, ClaimStatus):
            raise Unreachable("the answer to a claim is none: whoever answers is not the twin")
        self._twin_marks = status.protocol >= _MARKS
        return status

    def listen_anew(self) -> None:
        """End a poll whose answer may have been lost on the way; see `Transport`."""
        self._down.interrupt()

    def close(self) -> None:
        """Close both connections."""
        self._up.close()
        self._down.close()


def _headers(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}", "Accept": BODY}


def _claimed(claim: HeldClaim) -> dict[str, str]:
    return {CLAIM: claim.text} if claim.number else {}


def _checked(response: HttpAnswer, good: tuple[int, ...], mark: str | None = None) -> HttpAnswer:
    """Return a response whose status is good; raise `Refused` or `Unreachable` for any other.

    Only a reason code of the twin refuses a message; any other error, as of a proxy, means that the twin is out of
    reach. So does a refusal for good of another body than the one with that `mark`; None: the twin is of a version that
    does not tell.
    """
    if response.status in good:
        return response
    refusal = _refusal_body(response)
    if refusal is None:
        raise Unreachable(f"HTTP status {response.status}, without a reason code of the twin's")
    if response.status in _NO_ADDRESS and refusal.code is Refusal.NOT_UNDERSTOOD:
        raise Unreachable(f"the twin does not know the address: a proxy on the way changes it ({refusal.detail[:200]})")
    # One that is too large is refused before it is read.
    judged = refusal.code.temporary or refusal.code is Refusal.TOO_LARGE or mark in (None, refusal.mark)
    if not judged:
        raise Unreachable(f"{_OTHER_BODY} ({refusal.code.value}: {refusal.detail[:200]})")
    raise Refused(refusal.code, refusal.detail[:200], _retry_after_s(response.headers.get("Retry-After", "")))


def _refusal_body(response: HttpAnswer) -> _RefusalBody | None:
    """Read the body of a refusal; None: it has none of the twin's."""
    try:
        return msgspec.json.decode(response.body[:_LONGEST_ERROR], type=_RefusalBody)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None


def _refusal_of(response: HttpAnswer) -> Refusal | None:
    body = _refusal_body(response)
    return None if body is None else body.code


def _retry_after_s(text: str) -> float:
    """Time in a Retry-After header, s; 0 where it is no number of seconds."""
    return min(float(text), _LONGEST_PAUSE_S) if text.isascii() and text.isdigit() else 0.0


def _older_pause_s(text: str) -> float:
    """Pause before older windows, s; 0 where the header is no such time."""
    try:
        seconds = float(text or "0")
    except ValueError:
        return 0.0
    return min(seconds, LONGEST_OLDER_PAUSE_S) if seconds > 0.0 else 0.0


def _decode_list(body: bytes) -> list[bytes]:
    try:
        return msgspec.msgpack.decode(body, type=list[bytes])
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise Unreachable("the answer is not a list of messages: whoever answers is not the twin") from None


def _is(expected: Acknowledge, data: bytes) -> bool:
    try:
        return decode(data) == expected
    except InvalidMessage:
        return False
