"""From a window message to numbers: the only way in which measurements reach an estimator."""

from __future__ import annotations

import numpy as np

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.identify.window import CHANNELS, Window
from servotwin.plant.signals import Array


def decode_window(message: messages.Window) -> Window:
    """The numeric window of a message; channels that no estimator knows are left out.

    Raises
    ------
    InvalidInput
        The position is missing, a channel has another unit than the estimators expect, or is too short.
    """
    source = "window {}/{}/{}".format(*message.identity)
    known = {channel.name: channel for channel in message.channels if channel.name in CHANNELS}
    for name, channel in known.items():
        if channel.unit != CHANNELS[name]:
            raise InvalidInput(f"{source}: channel {name} is in {channel.unit!r}; it must be in {CHANNELS[name]!r}")
    if "position" not in known:
        raise InvalidInput(f"{source}: channel 'position' is missing; it has {', '.join(sorted(known)) or 'none'}")
    values = {name: decode_channel(channel) for name, channel in known.items()}
    return Window(**values, sample_rate=message.rate, start=message.start, source=source)


def decode_channel(channel: messages.Channel) -> Array:
    """(n,) samples in the channel's unit, bit for bit those of `messages.unpack_channel`."""
    codes = np.frombuffer(channel.data, dtype="<i2")
    return np.asarray(channel.offset + channel.scale * codes.astype(np.float64))
