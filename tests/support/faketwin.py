"""A twin for tests of the edge: the real addresses on a real socket, no estimation; it misbehaves when told to."""

import contextlib
import json
import socket
import threading
import zlib
from collections import Counter
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import msgspec

from servotwin.link.seal import TO_EDGE, key_of, seal, verifier_of
from servotwin.messages import Acknowledge, ClaimStatus, EdgeClaim, Message, Refusal, WindowMessage, decode, encode

Fault = Callable[["Handler", bytes], bool]
"""Looks at a request; whether it has answered it (badly) itself."""


class FakeTwin:
    """Keeps what it is sent; `say` queues messages for the edge."""

    def __init__(self, servo: str = "axis-1", token: str = "secret") -> None:
        self.servo, self.token = servo, token
        self.windows: dict[tuple[str, int], WindowMessage] = {}
        self.letters: list[Message] = []
        self.requests: Counter[str] = Counter()
        self.sealed: list[tuple[int, bytes]] = []
        self.fault: Fault | None = None
        self.older_pause = ""
        self.waiting: list[str | None] = []
        self.claim_status: ClaimStatus | None = None  # None: of a version without claims
        self.on_window: Callable[[WindowMessage], None] = lambda _: None
        self.news, self.closed = threading.Condition(), False
        self.sockets: set[socket.socket] = set()
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), type("Bound", (Handler,), {"twin": self}))
        self.server.daemon_threads = True
        self.server.handle_error = lambda *_: None  # an edge that is killed leaves its connections as they are
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True)
        self.thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server.server_address[1]}"

    def say(self, message: Message, serial: int | None = None, token: str | None = None) -> int:
        """Queue a message; its serial."""
        with self.news:
            number = serial if serial is not None else max((s for s, _ in self.sealed), default=0) + 1
            key = key_of(verifier_of(token or self.token))
            self.sealed.append((number, seal(key, TO_EDGE, self.servo, number, encode(message))))
            self.news.notify_all()
            return number

    def close(self) -> None:
        with self.news:
            self.fault, self.closed = None, True
            self.news.notify_all()
        self.server.shutdown()
        for each in list(self.sockets):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        self.server.server_close()
        self.thread.join(5.0)

    def __enter__(self) -> "FakeTwin":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    twin: FakeTwin
    timeout = 60.0

    def setup(self) -> None:
        super().setup()
        self.twin.sockets.add(self.request)

    def finish(self) -> None:
        self.twin.sockets.discard(self.request)
        with contextlib.suppress(OSError):
            super().finish()

    def do_PUT(self) -> None:
        self._take()

    def do_POST(self) -> None:
        self._take()

    def do_GET(self) -> None:
        if self._stopped(b""):
            return
        query = dict(pair.split("=") for pair in self.path.partition("?")[2].split("&"))
        after, wait = int(query["after"]), float(query["wait"])
        with self.twin.news:
            self.twin.news.wait_for(lambda: self.twin.closed or any(s > after for s, _ in self.twin.sealed), wait)
            found = [data for serial, data in self.twin.sealed if serial > after]
        self.answer(200, msgspec.msgpack.encode(found))

    def _take(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self._stopped(body):
            return
        if self.headers.get("Content-Encoding") == "deflate":
            body = zlib.decompress(body)
        message = decode(body)
        if isinstance(message, EdgeClaim):
            self._answer_claim(message)
            return
        if not isinstance(message, WindowMessage):
            self.twin.letters.append(message)
            self.answer(202, b"")
            return
        key = message.boot, message.sequence
        assert self.path == f"/v1/servos/{self.twin.servo}/windows/{key[0]}/{key[1]}"
        status = 200 if key in self.twin.windows else 201
        self.twin.windows[key] = message
        self.twin.on_window(message)
        self.twin.waiting.append(self.headers.get("Servotwin-Waiting"))
        self.answer(
            status,
            msgspec.msgpack.encode([encode(Acknowledge(message.servo, *key))]),
            **({"Servotwin_Older_Pause": self.twin.older_pause} if self.twin.older_pause else {}),
        )

    def _answer_claim(self, claim: EdgeClaim) -> None:
        newest = self.twin.claim_status
        if newest is None:
            self.refuse(404, Refusal.NOT_UNDERSTOOD)
            return
        if claim.takes == newest.number + 1:
            newest = self.twin.claim_status = ClaimStatus(claim.servo, claim.run, claim.takes)
        self.answer(200, encode(newest))

    def _stopped(self, body: bytes) -> bool:
        self.twin.requests[self.command] += 1
        if self.twin.fault is not None and self.twin.fault(self, body):
            return True
        if self.headers.get("Authorization") != f"Bearer {self.twin.token}":
            self.refuse(401, Refusal.BAD_TOKEN)
            return True
        newest, claim = self.twin.claim_status, self.headers.get("Servotwin-Claim")
        if newest is not None and claim is not None and claim != f"{newest.number} {newest.run}":
            self.refuse(409, Refusal.SUPERSEDED)
            return True
        return False

    def refuse(self, status: int, code: Refusal, **headers: str) -> None:
        self.answer(status, json.dumps({"code": code.value, "detail": "As told."}).encode(), **headers)

    def answer(self, status: int, body: bytes, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing is printed."""
