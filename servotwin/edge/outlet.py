"""Outlet of the agent's cut windows: the protocol, and the outlet that puts them into an outbox of this process.

The edge process hands them to a link process instead, so that neither packing nor the disk delays a sample. Both write
windows into an outbox by a `WindowWriter`. Who sends them from there, a `servotwin.link.session.Session` with a
transport or a simulated link, is no concern of the agent's.
"""

from array import array
from collections import Counter
from collections.abc import Mapping
from itertools import chain, pairwise
from typing import Protocol

from servotwin.edge.recorder import Cut
from servotwin.edge.settings import AgentSettings
from servotwin.edge.window_filter import WindowFilter, WindowFilterSettings
from servotwin.errors import InvalidInput
from servotwin.link.outbox import MemoryOutbox, Outbox
from servotwin.messages import (
    Channel,
    InvalidMessage,
    LearntResponse,
    WindowMessage,
    checksum,
    pack_channel,
    pack_finely,
)
from servotwin.messages.checks import all_finite

CHANNELS = {"reference": "m", "theta_m": "rad", "position": "m", "voltage": "V"}
"""Channels, in this order, with their units."""

MOTOR = "theta_m"


def recorded_channels(motor_encoder: bool) -> tuple[str, ...]:
    """Names of the channels that an edge records: all, or all that are measured without an encoder of the motor."""
    return tuple(name for name in CHANNELS if motor_encoder or name != MOTOR)


MAX_CHANGES = 256
"""Reference changes listed per window; the reference channel has them all."""


def pack(cut: Cut, settings: AgentSettings, response_version: int | None = None) -> WindowMessage:
    """Pack a cut into the window message, with the version of the response that its filter used, if it has one.

    Raises
    ------
    InvalidMessage
        A sample is not finite.
    """
    # Without an encoder the twin computes the motor's angle from the command, whose rounding it would integrate.
    fine = "voltage" if not settings.motor_encoder else MOTOR if settings.fine_angle else ""
    packed = (_packed(name, values, name == fine) for name, values in cut.signals.items())
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
        response_version=response_version,
    )


def is_finite(cut: Cut) -> bool:
    """True where no sample is missing: only then can a cut be filtered or sent."""
    return all(map(all_finite, cut.signals.values()))


def _packed(name: str, values: "array[float]", fine: bool) -> tuple[Channel, ...]:
    if fine:
        return pack_finely(name, CHANNELS[name], values)
    return (pack_channel(name, CHANNELS[name], values),)


def _changes(cut: Cut, rate: float) -> tuple[tuple[float, float], ...]:
    """List (time, new value) of the first changes of the reference inside a window."""
    steps = enumerate(pairwise((cut.before, *cut.signals["reference"])), cut.first)
    changes = [(index / rate, new) for index, (old, new) in steps if new != old]
    return tuple(changes[:MAX_CHANGES])


NOT_FINITE = "sample not finite"
FILTERED = "nothing new"
"""Reasons of windows that are not sent."""

UNFILTERED, NOT_ADOPTED = "window not judged", "learnt response not used"
"""Faults of a window, and of a response from the twin, at which the filter failed."""

_FILTER_STATE = "novelty"  # its name in outboxes on disk since the first filter


class Outlet(Protocol):
    """Interface through which the agent sends its windows."""

    @property
    def unacknowledged(self) -> bool:
        """True where a window waits for the twin's acknowledgement."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of windows dropped without an acknowledgement, by reason."""

    def offer(self, cut: Cut) -> None:
        """Take over a cut window."""

    def adopt(self, response: LearntResponse) -> None:
        """Take a learnt response, for the windows that are cut from now on."""


class WindowWriter:
    """Filters the cut windows of one boot, packs them and puts them into an outbox.

    Parameters
    ----------
    settings : AgentSettings
        Settings of that boot; its window filter goes on from the state that an earlier boot left in the outbox.
    outbox : Outbox
    faults : Counter, optional
        Counts the windows whose filter failed or did not start, which are then sent; None: such an error is raised.
    """

    def __init__(self, settings: AgentSettings, outbox: Outbox, faults: Counter[str] | None = None) -> None:
        self._settings, self._outbox, self._faults = settings, outbox, faults
        self._filter: WindowFilter | None = None
        self._not_started = False
        if settings.window_filter is not None:
            try:
                self._filter = _started(settings.window_filter, outbox.value(_FILTER_STATE))
            except Exception:  # its libraries may not run here: without machine code that is made at run time
                if faults is None:
                    raise
                self._not_started = True

    def write(self, cut: Cut) -> None:
        """Put a window into the outbox, or count why it is not sent."""
        chosen = self._filtered(cut) if is_finite(cut) else cut  # packing refuses one that is not finite
        if chosen is None:
            self._outbox.count_dropped(FILTERED)
            return
        try:
            version = None if self._filter is None else self._filter.response_version
            window = pack(chosen, self._settings, version)
        except InvalidMessage:
            self._outbox.count_dropped(NOT_FINITE)
        else:
            self._outbox.put(window)

    def adopt(self, response: LearntResponse) -> None:
        """Have the filter use a learnt response; without a filter nothing changes."""
        if self._filter is None:
            return
        try:
            self._filter.adopt(response)
        except Exception:
            if self._faults is None:
                raise
            self._faults[NOT_ADOPTED] += 1
            return
        self._outbox.set_value(_FILTER_STATE, self._filter.dumps())

    def _filtered(self, cut: Cut) -> Cut | None:
        if self._filter is None:
            if self._not_started and self._faults is not None:
                self._faults[UNFILTERED] += 1
            return cut
        try:
            chosen = self._filter(cut)
        except Exception:  # a fault of an optional feature must not cost a window
            if self._faults is None:
                raise
            self._faults[UNFILTERED] += 1
            return cut
        self._outbox.set_value(_FILTER_STATE, self._filter.dumps())
        return chosen


def _started(settings: WindowFilterSettings, saved: bytes | None) -> WindowFilter:
    """Start a filter on what an earlier boot left; anew where that is none of its states."""
    try:
        return settings.start(saved)
    except InvalidInput:
        return settings.start()


class LocalOutlet:
    """Puts windows into an outbox of this process.

    Parameters
    ----------
    settings : AgentSettings
    outbox : Outbox, optional
        In memory by default.
    """

    def __init__(self, settings: AgentSettings, outbox: Outbox | None = None) -> None:
        self.outbox = MemoryOutbox() if outbox is None else outbox
        self._writer = WindowWriter(settings, self.outbox)

    @property
    def unacknowledged(self) -> bool:
        """True where a window waits for the twin's acknowledgement."""
        return self.outbox.waiting > 0

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of windows dropped without an acknowledgement, by reason."""
        return self.outbox.dropped

    def offer(self, cut: Cut) -> None:
        """Take over a cut window."""
        self._writer.write(cut)

    def adopt(self, response: LearntResponse) -> None:
        """Have the window filter use a learnt response from the next window on."""
        self._writer.adopt(response)
