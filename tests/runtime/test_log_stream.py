"""Log lines where nobody reads them, or their disk is full."""

import os
from pathlib import Path

from servotwin.runtime.log_stream import LogStream


def test_lines_into_a_pipe_that_nobody_reads_are_counted_and_later_ones_are_whole() -> None:
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as out, os.fdopen(writer, "w", encoding="utf-8") as pipe:
        stream = LogStream(pipe)
        for number in range(2000):
            stream.write(f"{number:0100d}")
        read = os.read(out.fileno(), 1 << 20).decode().splitlines()
        assert read == [f"{number:0100d}" for number in range(len(read))]
        assert 0 < stream.lost == 2000 - len(read)
        stream.write("whole")
        assert (os.read(out.fileno(), 100), stream.lost) == (b"whole\n", 0)


def test_a_line_longer_than_a_pipe_has_room_does_not_wait() -> None:
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb"), os.fdopen(writer, "w", encoding="utf-8") as pipe:
        stream = LogStream(pipe)
        stream.write("\u00e4" * 1_000_000)
        assert stream.lost == 1


def test_lines_for_a_full_disk_and_for_nobody_are_counted() -> None:
    stream = LogStream(None)
    stream.write("unheard")
    with Path("/dev/full").open("w") as full:
        stream.stream = full
        stream.write("unheard")
        assert stream.lost == 2
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())  # so that its close does not fail
