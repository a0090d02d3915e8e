"""From a window message to numbers: the only way in which measurements reach an estimator."""

from __future__ import annotations

import numpy as np

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.estimation.window import CHANNELS, Window
from servotwin.plant.signals import Array


def decode_window(message: messages.Window) -> Window:
    """The numeric window of a message; channels that no estimator knows are left out.

    Raises
    ------
    InvalidInput
        The position is missing, a channel has another unit than the estimators expect, or is too short.
    """
    source = "window {}/{}/{}".format(*message.identity)
    channels = {channel.name: channel for channel in message.channels}
    known = {name: channel for name, channel in channels.items() if name.removesuffix(messages.FINE) in CHANNELS}
    for name, channel in known.items():
        unit = CHANNELS[name.removesuffix(messages.FINE)]
        if channel.unit != unit:
            raise InvalidInput(f"{source}: channel {name} is in {channel.unit!r}; it must be in {unit!r}")
    if "position" not in known:
        raise InvalidInput(f"{source}: channel 'position' is missing; it has {', '.join(sorted(known)) or 'none'}")
    values = {name: decode_channel(channel) for name, channel in known.items() if name in CHANNELS}
    for name in values:
        if name + messages.FINE in known:
            values[name] += decode_channel(known[name + messages.FINE])
    return Window(**values, sample_rate=message.rate, start=message.start, source=source)


def decode_channel(channel: messages.Channel) -> Array:
    """(n,) samples in the channel's unit, bit for bit those of `messages.unpack_channel`."""
    codes = np.frombuffer(channel.data, dtype="<i2")
    return np.asarray(channel.offset + channel.scale * codes.astype(np.float64))
