"""Bags of ROS 2 in MCAP files: positions, velocities and efforts of `sensor_msgs/msg/JointState`."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns, Requested
from servotwin.logs.own_times import TimedChannel, one_table
from servotwin.plant.signals import Array
from servotwin.runtime.extras import require

_KIND = "sensor_msgs/msg/JointState"
_FIELDS = ("position", "velocity", "effort")


class JointState(NamedTuple):
    """One message: time in s (0: not stamped), names of the joints, and their (n,) arrays, empty where left out."""

    stamp: float
    names: tuple[str, ...]
    position: Array
    velocity: Array
    effort: Array


def joint_state(data: bytes) -> JointState:
    """Decode a message in the common data representation (CDR) of ROS 2, in either byte order.

    Raises
    ------
    ValueError
        It ends before its content does.
    """
    order, place = ("<" if data[1:2] == b"\x01" else ">"), 4

    def take(form: str, count: int = 1) -> tuple[int | float, ...]:
        nonlocal place
        size = struct.calcsize(form)
        place += (4 - place) % size  # aligned from the end of the four-byte head on
        if count < 0 or place + count * size > len(data):
            raise ValueError("a message ends too early")
        found = struct.unpack_from(f"{order}{count}{form}", data, place)
        place += count * size
        return found

    def text() -> str:
        nonlocal place
        size = int(take("I")[0])
        if place + size > len(data):
            raise ValueError("a message ends too early")
        found = data[place : place + size].rstrip(b"\0").decode(errors="replace")
        place += size
        return found

    (seconds,), (nanoseconds,) = take("i"), take("I")
    text()  # the frame
    names = tuple(text() for _ in range(int(take("I")[0])))
    numbers = []
    for _ in _FIELDS:
        (count,) = take("I")
        numbers.append(np.array(take("d", int(count)) if count else ()))
    return JointState(seconds + 1e-9 * nanoseconds, names, *numbers)


def read_mcap(path: Path, requested: Requested) -> LogColumns:
    """Read joints as topic/joint.position, topic/joint.velocity and topic/joint.effort; with one topic without it.

    Times are the messages' own stamps, or those of the recording where a topic is not stamped.

    Raises
    ------
    InvalidInput
        mcap is not installed, the file is damaged, or holds no joint states.
    """
    library = require("mcap.reader", f"log {path}")
    found: dict[str, list[tuple[float, JointState]]] = {}
    try:
        with path.open("rb") as file:
            for schema, channel, message in library.make_reader(file).iter_messages():
                if schema is not None and schema.name == _KIND:
                    state = joint_state(message.data)
                    found.setdefault(channel.topic, []).append((1e-9 * message.log_time, state))
    # The library raises whatever a damaged file leads to.
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InvalidInput(f"log {path}: is not an MCAP file that can be read ({reason})") from None
    if not found:
        raise InvalidInput(f"log {path}: holds no messages of the type {_KIND}, which alone are read")
    channels: dict[str, TimedChannel] = {}
    for topic, messages in found.items():
        channels |= _channels("" if len(found) == 1 else f"{topic.strip('/')}/", messages)
    return one_table(tuple(channels), requested, channels.__getitem__)


def _channels(prefix: str, messages: list[tuple[float, JointState]]) -> dict[str, TimedChannel]:
    """Fields of every joint; a message that leaves one out is no sample of it."""
    stamped = all(state.stamp > 0.0 for _, state in messages)
    rows: dict[str, list[tuple[float, float]]] = {}
    for logged, state in messages:
        time = state.stamp if stamped else logged
        for field in _FIELDS:
            for joint, value in zip(state.names, getattr(state, field), strict=False):
                rows.setdefault(f"{prefix}{joint}.{field}", []).append((time, float(value)))
    return {name: TimedChannel(*np.array(samples).T) for name, samples in rows.items()}
