"""Frames over a stream: whole, in order, and never waited for."""

import io
import socket
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.runtime.frames import FrameError, FrameSocket, frame, read_frame


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    yield ours, theirs
    ours.close()
    theirs.close()


@given(st.lists(st.binary(max_size=200_000), max_size=5), st.integers(1, 50_000))
def test_frames_cross_a_pipe_whole_and_in_order(sent: list[bytes], piece: int) -> None:
    ours, theirs = socket.socketpair()
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, piece)
    near, far = FrameSocket(ours), FrameSocket(theirs)
    for body in sent:
        near.post(body)
    came: list[bytes] = []
    while near.backlog:
        near.send()
        came += far.receive()
    for _ in range(3):
        came += far.receive()
    assert came == sent
    near.close()
    far.close()


def test_a_pipe_never_waits_and_knows_when_the_other_end_is_gone(ends: tuple[socket.socket, socket.socket]) -> None:
    near = FrameSocket(ends[0])
    assert near.receive() == []
    near.post(bytes(10_000_000))
    for _ in range(1000):
        near.send()
    assert near.backlog > 0
    assert not near.broken
    ends[1].close()
    near.send()
    assert near.broken


def test_a_frame_that_is_longer_than_any_is_refused(ends: tuple[socket.socket, socket.socket]) -> None:
    ends[1].sendall(b"\xff\xff\xff\xff")
    with pytest.raises(FrameError, match="4294967295 bytes"):
        FrameSocket(ends[0]).receive()


@given(st.lists(st.binary(max_size=300), max_size=5), st.integers(0, 3))
def test_a_stream_that_ends_within_a_frame_has_ended(bodies: list[bytes], cut: int) -> None:
    stream = io.BytesIO(b"".join(map(frame, bodies)) + frame(b"last")[:cut])
    assert [read_frame(stream) for _ in bodies] == bodies
    assert read_frame(stream) is None
