"""`servotwin bench overload`: its edges judge updates as real ones do; figures of events."""

import io
from typing import Any

import msgspec
import pytest
from rich.console import Console
from twin_messages import window_message

from benchmarks.overload import BOOT, OverloadEdge, OverloadOutcome, longest_pause, shown
from servotwin.link.seal import TO_EDGE, key_of, seal, verifier_of
from servotwin.messages import Receipt, Setting, Update, WindowMessage, decode, encode
from servotwin.messages.codec import decompress


class Line:
    """A connection that answers polls with messages, and keeps what it is sent."""

    def __init__(self, *messages: Update) -> None:
        key = key_of(verifier_of(""))
        self.waiting = [seal(key, TO_EDGE, "ax-1", n + 1, encode(each)) for n, each in enumerate(messages)]
        self.sent: list[Any] = []
        self.status, self.answer = 201, b""

    def request(self, method: str, _path: str, body: bytes | None, headers: dict[str, str]) -> None:
        self.status = 200 if method == "GET" else 201
        self.answer = msgspec.msgpack.encode(self.waiting) if method == "GET" else b""
        if body is not None:
            self.sent.append(decode(decompress(body, headers.get("content-encoding", ""), 10**6)))

    def getresponse(self) -> "Line":
        return self

    def read(self) -> bytes:
        return self.answer


def update(version: int, base: int, not_after: float = 1e9) -> Update:
    return Update(
        "ax-1", version, base, (BOOT, version), float(version), 0.1, 0.01, (0.0, 0.2), "ok", Setting(1e-4), not_after
    )


def test_an_update_is_applied_or_refused_for_its_true_reason() -> None:
    line = Line(update(1, 0), update(2, 7), update(3, 7, not_after=0.0))
    edge = OverloadEdge("ax-1", [window_message()], 0)
    edge.poll(line, -100.0, 0.0)  # the run began long ago
    assert edge.reasons == {"applied": 1, "base is not the version in force": 1, "expired": 1}
    assert [(sent.version, sent.parameter_version) for sent in line.sent if isinstance(sent, Receipt)] == [
        (1, 1),
        (2, 1),
        (3, 1),
    ]
    assert (len(edge.applied_at), edge.serial) == (1, 3)


def test_windows_end_when_they_are_sent() -> None:
    line, edge = Line(), OverloadEdge("ax-1", [window_message()], 0)
    edge.send(line, 50.0)
    edge.send(line, 55.0)
    first, second = line.sent
    assert isinstance(first, WindowMessage)
    assert (first.servo, first.boot, first.sequence, second.sequence) == ("ax-1", BOOT, 0, 1)
    assert second.start - first.start == pytest.approx(5.0)
    assert first.start + first.samples / first.rate == pytest.approx(60.0)
    assert len(edge.latencies) == 2


def test_the_longest_pause_counts_begin_and_end() -> None:
    assert longest_pause([], 30.0) == 30.0
    assert longest_pause([4.0, 5.0], 30.0) == 25.0
    assert longest_pause([12.0, 29.0], 30.0) == 17.0


def test_figures_are_shown() -> None:
    outcome = OverloadOutcome(
        2.0, 10.0, 900, 100, 95, {"applied": 95, "expired": 5}, 7, 9.5, 0.01, 0.2, 3.0, 12, 10**8, 10**8
    )
    text = io.StringIO()
    Console(file=text, width=120).print(shown(outcome))
    assert "100, 95 (95.0 %)" in text.getvalue()
    assert "95 applied, 5 expired" in text.getvalue()
