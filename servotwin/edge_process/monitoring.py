"""Monitoring of an edge: its log on the standard error, its status file, and a histogram of tick times."""

from __future__ import annotations

import errno
import os
import sys
import time
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from servotwin.runtime.files import replace_file
from servotwin.runtime.log_stream import LogStream

if TYPE_CHECKING:
    from servotwin.link.sqlite_outbox import SqliteOutbox

_STATUS_SCHEMA = "servotwin-edge-status/1"
_FORMER = "not tried again since the link process was started anew; before: "
BINS = 4096
"""Bins of one microsecond; a longer time counts in the last one."""

_TYPECODE = "Q"  # 64 bits on every machine: at 5 kHz 32 bits are full in ten days


class TroubleLog:
    """Logs the trouble of each part once, again when it changes, and when it is over.

    Parameters
    ----------
    logged : mapping of str to str, optional
        Troubles of parts that are in the log already.
    """

    def __init__(self, logged: Mapping[str, str] | None = None) -> None:
        self._logged = dict(logged or {})

    def logged(self, where: str) -> str:
        """Trouble of a part by the log; empty: there is none."""
        return self._logged.get(where, "")

    def update(self, where: str, why: str) -> None:
        """Log a change; `why` is the present trouble of a part, empty: there is none."""
        if why != self._logged.get(where, ""):
            self._logged[where] = why
            if why:
                log("trouble", where=where, why=why)
            else:
                log("trouble over", where=where)


_stream = LogStream(None)


def log(event: str, **values: Any) -> None:
    """Write one JSON line to the standard error; where that is closed, or nobody reads it, the next line counts it."""
    lost = {"lines_lost": _stream.lost} if _stream.lost else {}
    line = {"time": round(time.time(), 3), "event": event, **values, **lost}
    _stream.stream = sys.stderr
    _stream.write(msgspec.json.encode(line).decode())


def log_outbox(outbox: SqliteOutbox) -> None:
    """Log, once, what an outbox found in place of its file: an incomplete one, another servo's, a corrupt one, none."""
    if outbox.missing:
        log("outbox incomplete", lost=outbox.missing)
        outbox.missing = 0
    while outbox.others:
        other = outbox.others.pop(0)
        log("outbox of another servo", file=other.file.name, of=other.servo, windows=other.waiting)
    while outbox.moves:
        moved = outbox.moves.pop(0)
        log("outbox moved", files=moved.files, **({} if moved.aside is None else {"aside": moved.aside.name}))
    while outbox.salvages:
        found = outbox.salvages.pop(0)
        log("outbox broken", file=found.file.name, rescued=found.rescued, lost=found.lost)


def write_status(path: Path, status: Mapping[str, Any]) -> None:
    """Replace the status file; raises OSError."""
    # Not durable: a status is outdated in a second, and a flush to a slow disk may take as long.
    text = msgspec.json.format(msgspec.json.encode({"schema": _STATUS_SCHEMA, **status}))
    replace_file(path, text + b"\n", mode=0o600)


def overwrite_status(path: Path, status: Mapping[str, Any]) -> None:
    """Write the status over the present file, without a byte of new space; raises OSError.

    A reader may meanwhile find half of it, which `read_status` takes for none.
    """
    data = msgspec.json.encode({"schema": _STATUS_SCHEMA, **status})
    with path.open("r+b", buffering=0) as file:
        room = file.seek(0, os.SEEK_END)
        if len(data) > room:
            few = {name: status[name] for name in ("servo", "disk", "written") if name in status}
            data = msgspec.json.encode({"schema": _STATUS_SCHEMA, **few})
        if len(data) > room:
            raise OSError(errno.ENOSPC, "the status is longer than its file")
        file.seek(0)
        file.write(data.ljust(room))


def read_status(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Read the last status; None: there is no file, or it does not hold a status."""
    try:
        status = msgspec.json.decode(Path(path).read_bytes())
    except (OSError, msgspec.MsgspecError, RecursionError):
        return None
    return status if isinstance(status, dict) and status.get("schema") == _STATUS_SCHEMA else None


def former_trouble(last: Mapping[str, Any], run: str, way: str) -> str:
    """Trouble in a direction, by the last status, where that is one of the same run; empty: there was none.

    It lasts until the twin answers, but in other words, so that it is logged again where it goes on.
    """
    told = last.get(way)
    why = told.get("trouble") if isinstance(told, dict) and last.get("run") == run else None
    return _FORMER + why.removeprefix(_FORMER) if isinstance(why, str) and why else ""


class TickHistogram:
    """Histogram of durations by microseconds: cheap to add to, of fixed size."""

    def __init__(self) -> None:
        self.bins = array(_TYPECODE, bytes(array(_TYPECODE).itemsize * BINS))
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """Count one duration."""
        self.bins[min(max(int(seconds * 1e6), 0), BINS - 1)] += 1
        if seconds > self.longest:
            self.longest = seconds

    def dumps(self) -> bytes:
        """Encode the bins."""
        return self.bins.tobytes()


def summarise(data: bytes, longest: float) -> dict[str, float]:
    """Number, and median, p99, p99.9 and maximum in microseconds, of `TickHistogram.dumps`.

    A quantile beyond the bins is given as the longest duration.
    """
    bins = array(_TYPECODE)
    bins.frombytes(data)
    total = sum(bins)
    shares = {"median_us": 0.5, "p99_us": 0.99, "p999_us": 0.999}
    quantiles = {name: float(_quantile(bins, total, share)) for name, share in shares.items()}
    quantiles = {name: value if value < BINS else round(longest * 1e6, 1) for name, value in quantiles.items()}
    return {"number": total, **quantiles, "max_us": round(longest * 1e6, 1)}


def _quantile(bins: array[int], total: int, share: float) -> int:
    """End of the bin, us, below which that share of the durations lies."""
    need, count = share * total, 0
    for microsecond, number in enumerate(bins):
        count += number
        if count >= need and count > 0:
            return microsecond + 1
    return 0
