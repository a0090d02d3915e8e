"""The live view: extremes of an edge's samples, column by column, and the twin's word whether somebody watches.

They are no part of the record: nothing is stored, repeated or numbered by serials. A twin of a version without the live
view has no address for them, and answers so.
"""

from math import isfinite
from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta, Struct

from servotwin.messages.checks import Count, InvalidMessage, Name, require

COLUMN_S = 0.1
"""s of one column."""
MAX_LIVE_COLUMNS, MAX_LIVE_BYTES = 256, 16_384
"""Columns of one message, and bytes of it."""
LIVE_CHANNELS = "position", "error", "voltage"
"""Channels of a column: m or rad, the same (reference less position), and the command to the motor."""

_T = TypeVar("_T")
_Extreme = float | None
LiveColumn = tuple[_Extreme, _Extreme, _Extreme, _Extreme, _Extreme, _Extreme]
"""Least and greatest value of each of `LIVE_CHANNELS`; None: no sample of the column is a number."""


class LiveColumns(Struct, frozen=True, omit_defaults=True, tag="live/1"):
    """Columns of one boot, one after the other.

    Attributes
    ----------
    boot : int
        Number of the boot since the start of the edge's process.
    first : int
        Number of the first column since the start of the boot.
    width : float
        s of a column.
    columns : tuple of LiveColumn
        Empty: the edge asks whether somebody watches.
    """

    servo: Name
    boot: Count = 0
    first: Count = 0
    width: float = COLUMN_S
    columns: Annotated[tuple[LiveColumn, ...], Meta(max_length=MAX_LIVE_COLUMNS)] = ()

    def __post_init__(self) -> None:
        require(isfinite(self.width) and self.width > 0.0, f"live width {self.width} s is not positive")
        values = (value for column in self.columns for value in column if value is not None)
        require(all(map(isfinite, values)), "live columns must be finite, or nothing")


class Watched(Struct, frozen=True, tag="watched/1"):
    """The twin's answer: True while somebody watches the servo."""

    watched: bool


_columns = msgspec.msgpack.Decoder(LiveColumns)
_watched = msgspec.msgpack.Decoder(Watched)
encode_live = msgspec.msgpack.Encoder().encode


def decode_columns(data: bytes) -> LiveColumns:
    """Decode what an edge sends; raises InvalidMessage."""
    require(len(data) <= MAX_LIVE_BYTES, f"live columns of {len(data)} bytes: at most {MAX_LIVE_BYTES} are allowed")
    return _decoded(_columns, data)


def decode_watched(data: bytes) -> Watched:
    """Decode the twin's answer; raises InvalidMessage."""
    return _decoded(_watched, data)


def _decoded(decoder: "msgspec.msgpack.Decoder[_T]", data: bytes) -> _T:
    try:
        return decoder.decode(data)
    except InvalidMessage:
        raise
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
        raise InvalidMessage(f"live message not understood: {error}") from None
