"""Packing of cut samples into a window: int16 channels, the list of reference changes, a checksum."""

from array import array
from itertools import chain, pairwise

from servotwin.edge.recorder import Cut
from servotwin.edge.settings import AgentSettings
from servotwin.messages import Channel, WindowMessage, checksum, pack_channel, pack_finely
from servotwin.messages.checks import all_finite

CHANNELS = {"reference": "m", "theta_m": "rad", "position": "m", "voltage": "V"}
"""Recorded channels, in this order, with their units."""

MAX_CHANGES = 256
"""Reference changes listed per window; the reference channel has them all."""


def pack(cut: Cut, settings: AgentSettings) -> WindowMessage:
    """Pack a cut into the window message.

    Raises
    ------
    InvalidMessage
        A sample is not finite.
    """
    packed = (_packed(name, values, settings.fine_angle) for name, values in cut.signals.items())
    channels = tuple(chain.from_iterable(packed))
    return WindowMessage(
        servo=settings.servo,
        boot=settings.boot,
        sequence=cut.sequence,
        start=cut.first / settings.sample_rate,
        rate=settings.sample_rate,
        channels=channels,
        reference_changes=_changes(cut, settings.sample_rate),
        parameter_version=cut.parameter_version,
        model_version=settings.model_version,
        reason=cut.reason,
        crc=checksum(channels),
    )


def is_finite(cut: Cut) -> bool:
    """True where no sample is missing: only then can a cut be filtered or sent."""
    return all(map(all_finite, cut.signals.values()))


def _packed(name: str, values: "array[float]", fine_angle: bool) -> tuple[Channel, ...]:
    if fine_angle and name == "theta_m":
        return pack_finely(name, CHANNELS[name], values)
    return (pack_channel(name, CHANNELS[name], values),)


def _changes(cut: Cut, rate: float) -> tuple[tuple[float, float], ...]:
    """List (time, new value) of the first changes of the reference inside a window."""
    steps = enumerate(pairwise((cut.before, *cut.signals["reference"])), cut.first)
    changes = [(index / rate, new) for index, (old, new) in steps if new != old]
    return tuple(changes[:MAX_CHANGES])
