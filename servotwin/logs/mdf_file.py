"""MDF files, versions 3 and 4, by asammdf: every channel of numbers is a column, with its unit in the name."""

from __future__ import annotations

import gc
import sys
import traceback
from collections.abc import Collection
from pathlib import Path

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns
from servotwin.logs.own_times import TimedChannel, one_table, with_unit
from servotwin.runtime.extras import require


def read_mdf(path: Path, requested: Collection[str]) -> LogColumns:
    """Read channels by name; of two with one name the second is called name (2), and so on.

    Raises
    ------
    InvalidInput
        asammdf is not installed, or the file is damaged.
    """
    asammdf = require("asammdf", f"log {path}")
    try:
        with path.open("rb") as opened, asammdf.MDF(opened) as file:
            places: dict[str, tuple[int, int]] = {}
            for group, each in enumerate(file.groups):
                master = file.masters_db.get(group)
                for index, channel in enumerate(each.channels):
                    if index != master:
                        name, again = str(channel.name), 2
                        while with_unit(name, channel.unit) in places:
                            name, again = f"{channel.name} ({again})", again + 1
                        places[with_unit(name, channel.unit)] = (group, index)

            def channel_of(name: str) -> TimedChannel:
                group, index = places[name]
                signal = file.get(group=group, index=index)
                return TimedChannel(np.asarray(signal.timestamps, dtype=float), signal.samples)

            return one_table(tuple(places), requested, channel_of)
    # The library raises whatever a damaged file leads to.
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        _let_go(error)
        raise InvalidInput(f"log {path}: is not an MDF file that can be read ({reason})") from None


def _let_go(error: Exception) -> None:
    """Drop what a failed reading holds: the library's half-made file complains on the standard error when it ends."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        traceback.clear_frames(error.__traceback__)
        error.__traceback__ = None
        gc.collect()
    finally:
        sys.unraisablehook = before
