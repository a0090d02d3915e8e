"""Long benchmarks in pieces that a file keeps."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks.batch import Batch, main, read, run
from benchmarks.policies.loops import BATCH
from benchmarks.policies.worn import worn_machines
from servotwin.errors import InvalidInput

QUIET = Console(file=io.StringIO())


def units(blocks: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, int]]:
    yield from ((f"{seed}/{block}/{place}", place) for place in range(count) for block in blocks)


def squared(place: int) -> dict[str, int]:
    return {"square": place * place}


SQUARES = Batch(units, squared, lambda *_: None, ("one", "two"))


def test_a_batch_does_only_what_its_file_lacks(tmp_path: Path) -> None:
    path = tmp_path / "squares.jsonl"
    assert run(SQUARES, path, ("one",), 2, 7, 1, 60.0, QUIET) == {"7/one/0": {"square": 0}, "7/one/1": {"square": 1}}
    path.write_bytes(path.read_bytes().replace(b'{"square":1}', b'{"square":5}'))
    found = run(SQUARES, path, ("one", "two"), 2, 7, 1, 60.0, QUIET)
    assert found["7/one/1"] == {"square": 5}
    assert found == read(path)
    assert len(found) == len(path.read_bytes().splitlines()) == 4


def test_a_line_that_was_cut_off_is_done_again(tmp_path: Path) -> None:
    path = tmp_path / "squares.jsonl"
    run(SQUARES, path, ("one",), 3, 7, 1, 60.0, QUIET)
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    run(SQUARES, path, ("one",), 3, 7, 1, 60.0, QUIET)
    assert path.read_bytes() == whole


def test_nothing_begins_once_the_time_is_over(tmp_path: Path) -> None:
    assert run(SQUARES, tmp_path / "none.jsonl", ("one",), 3, 7, 1, 0.0, QUIET) == {}
    assert not (tmp_path / "none.jsonl").exists()


def test_other_files_and_blocks_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.jsonl"
    path.write_text("hello\n")
    with pytest.raises(InvalidInput, match="line 1: is no record"):
        read(path)
    with pytest.raises(InvalidInput, match="--blocks 'rust': does not exist"):
        main(["loops", str(path), "--seed", "1", "--blocks", "rust"])


def test_a_batch_of_loops_has_the_machines_of_the_whole_benchmark() -> None:
    those = dict(BATCH.units(("bias", "delay"), 2, 5))
    assert list(those) == ["5/bias/0", "5/delay/0", "5/bias/1", "5/delay/1"]
    assert those["5/bias/1"].machine == worn_machines("bias", 3, 5)[1]
