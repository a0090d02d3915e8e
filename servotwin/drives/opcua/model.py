"""The information model: one object with these variables, in one namespace (docs/howto/write-a-drive.md).

Sample k of every signal is at index k modulo the arrays' length. The drive writes samples first and raises `Count`
afterwards, by at most `Block` samples at a time; so a reader of `Count`, the arrays, and `Count` again knows which
samples were not overwritten. The client writes the parameters first, then `Commit`: the drive reads them when `Commit`
changes, accepts all or none, and reports that in `Committed` and `Refused`.
"""

import msgspec

from servotwin.messages import AnyGains, CascadeGains, Gains, LinearGains

NAMESPACE = "urn:servotwin:drive:1"
OBJECT = "Drive"

FIXED = ("Rate", "Block")
"""Double, Hz; UInt32."""

SIGNALS = ("Reference", "ThetaM", "Position", "Voltage")
"""Double[]: m, rad, m, V."""

STATE = ("Machine", "Count", *SIGNALS, "Version", "Since", "Count")
"""String, the name of the machine's present run; UInt64, samples taken in it; the arrays; Int64, version in force, and
UInt64, the first sample under it; the count again. Read in this order in one request."""

PARAMETERS = ("NewVersion", "Tolerance", "SetGains")
"""Int64; Double, m (rotary: rad); Boolean, whether the gains count too."""


def variable(name: str) -> str:
    """Variable of a gain: `position_gain` is PositionGain."""
    return "".join(word[:1].upper() + word[1:] for word in name.split("_"))


def needed(gains: AnyGains) -> list[str]:
    """Variables without which a drive cannot run on these gains: those without a default, those that tell the law from
    others, and those that differ from their default; numbers of what is switched off are not needed."""
    fields = msgspec.structs.fields(type(gains))
    law = _LAW.get(type(gains), ())
    different = [
        each.name for each in fields if each.required or each.name in law or getattr(gains, each.name) != each.default
    ]
    on = {name for name in different if name not in _BELONGS}
    return [variable(each.name) for each in fields if _BELONGS.get(each.name, each.name) in on]


_LAW: dict[type, tuple[str, ...]] = {
    CascadeGains: ("position_gain", "velocity_gain"),
    LinearGains: ("gain", "integral_share"),
}
"""Gains that tell a law from others, and are needed whatever their values."""

_BELONGS = {"velocity_time": "velocity_feedforward", "notch_damping": "notch_hz", "notch_depth": "notch_hz"}
"""Gains that mean nothing where another one is 0."""

GAINS = tuple(
    dict.fromkeys(variable(name) for kind in (Gains, CascadeGains, LinearGains) for name in kind.__struct_fields__)
)
"""Double, but for IntegralOnly, a Boolean; units as of `servotwin.messages`. A drive has those of its own law."""

COMMIT = "Commit"
"""UInt32, another number each time."""

DECISION = ("Committed", "Refused")
"""UInt32, the last `Commit` that was decided; String, why not, or empty."""

EVERY = tuple(dict.fromkeys((*FIXED, *STATE, *PARAMETERS, COMMIT, *DECISION)))
