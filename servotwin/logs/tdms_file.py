"""TDMS files of LabVIEW, by npTDMS: every channel of numbers is a column, with its unit in the name."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns
from servotwin.logs.own_times import TimedChannel, one_table, with_unit
from servotwin.runtime.extras import require


def read_tdms(path: Path, requested: Collection[str]) -> LogColumns:
    """Read channels by name, group/channel where there are several groups.

    Channels with a sample interval (waveforms) have times; without one the log has none but those of a channel.

    Raises
    ------
    InvalidInput
        npTDMS is not installed, or the file is damaged.
    """
    nptdms = require("nptdms", f"log {path}")
    cut = False
    try:
        with path.open("rb") as opened, _silent(nptdms), nptdms.TdmsFile.open(opened) as file:
            cut = file.file_status.incomplete_final_segment
            groups = [group for group in file.groups() if group.channels()]
            channels = {_name(channel, len(groups) > 1): channel for group in groups for channel in group.channels()}
            if not any("wf_increment" in channel.properties for channel in channels.values()):
                found = {name: channel[:] for name, channel in channels.items() if name in requested}
                return LogColumns(found, tuple(channels), {}, ends_within_line=cut)

            def channel_of(name: str) -> TimedChannel:
                channel = channels[name]
                if "wf_increment" not in channel.properties:
                    raise InvalidInput(
                        f"channel {name!r} has no sample interval (wf_increment), others have: export one"
                    )
                interval = float(channel.properties["wf_increment"])
                begin = float(channel.properties.get("wf_start_offset", 0.0)) + _start(channel) - first
                time = np.asarray(begin + interval * np.arange(len(channel)), dtype=np.float64)
                return TimedChannel(time, channel[:])

            first = min(_start(channel) for channel in channels.values())

            return one_table(tuple(channels), requested, channel_of)._replace(ends_within_line=cut)
    # The library raises whatever a damaged file leads to.
    except Exception as error:
        reason = "it is cut off" if cut else (str(error).splitlines() or [type(error).__name__])[0]
        raise InvalidInput(f"log {path}: is not a TDMS file that can be read ({reason})") from None


@contextmanager
def _silent(nptdms: Any) -> Iterator[None]:
    """The library without its warnings on the standard error: that a file is cut off is told as a defect."""
    manager = nptdms.log.log_manager
    before = manager.log_level
    manager.set_level(logging.ERROR)
    try:
        yield
    finally:
        manager.set_level(before)


def _start(channel: Any) -> float:
    """Time at which a waveform starts, s since 1970; 0 where it does not say."""
    start = channel.properties.get("wf_start_time")
    return 0.0 if start is None else float(np.datetime64(start, "us").astype(np.int64)) * 1e-6


def _name(channel: Any, grouped: bool) -> str:
    name = f"{channel.group_name}/{channel.name}" if grouped else str(channel.name)
    return with_unit(name, str(channel.properties.get("unit_string", "")))
