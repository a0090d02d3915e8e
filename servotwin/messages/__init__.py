"""Messages between edge and twin: windows, receipts, answers and hellos up; updates, requests, responses and
acknowledgements down.

MessagePack with a tag that carries the schema's version ("window/1"); an unknown tag is refused, unknown fields of a
known tag are ignored. A window's channels are planar int16 with a scale and an offset each.
SI units throughout. Values that are not known, or bounds that do not exist, are None on the wire.
"""

from servotwin.messages.checks import NAME_PATTERN, InvalidMessage, Refusal, finite
from servotwin.messages.claims import PROTOCOL, ClaimStatus, EdgeClaim
from servotwin.messages.codec import MAX_BYTES, Message, ParameterMessage, decode, encode
from servotwin.messages.requests import (
    PROBE,
    TEACHING,
    Answer,
    Ask,
    LongerWindow,
    Probe,
    Request,
    RequestOutcome,
    Resend,
)
from servotwin.messages.responses import LearntResponse
from servotwin.messages.setting import AnyGains, Band, CascadeGains, Gains, LinearGains, Setting
from servotwin.messages.updates import (
    KNOWN_FIELDS,
    Cause,
    Fallback,
    Reason,
    Receipt,
    Update,
    Verification,
    needed_fields,
)
from servotwin.messages.windows import (
    FINE,
    Acknowledge,
    Channel,
    Hello,
    LetterAcknowledge,
    WindowMessage,
    checksum,
    pack_channel,
    pack_finely,
    unpack_channel,
)

__all__ = [
    "FINE",
    "KNOWN_FIELDS",
    "MAX_BYTES",
    "NAME_PATTERN",
    "PROBE",
    "PROTOCOL",
    "TEACHING",
    "Acknowledge",
    "Answer",
    "AnyGains",
    "Ask",
    "Band",
    "CascadeGains",
    "Cause",
    "Channel",
    "ClaimStatus",
    "EdgeClaim",
    "Fallback",
    "Gains",
    "Hello",
    "InvalidMessage",
    "LearntResponse",
    "LetterAcknowledge",
    "LinearGains",
    "LongerWindow",
    "Message",
    "ParameterMessage",
    "Probe",
    "Reason",
    "Receipt",
    "Refusal",
    "Request",
    "RequestOutcome",
    "Resend",
    "Setting",
    "Update",
    "Verification",
    "WindowMessage",
    "checksum",
    "decode",
    "encode",
    "finite",
    "needed_fields",
    "pack_channel",
    "pack_finely",
    "unpack_channel",
]  # fmt: skip
