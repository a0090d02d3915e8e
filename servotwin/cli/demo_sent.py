"""Table of what the twin of a demo sent: dead zone, gains over the machine's own, and the verification."""

from __future__ import annotations

from collections.abc import Sequence

from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.messages import AnyGains, CascadeGains, Gains, LinearGains, Update
from servotwin.plant.display_units import DisplayUnit

_SCALED = {
    Gains: {"Kp, Kd": "Kp", "Ki": "Ki"},
    CascadeGains: {"Kv": "position_gain", "Kp": "velocity_gain", "Ti": "integral_time"},
    LinearGains: {"gain": "gain", "integral": "integral_gain"},
}
"""Columns of each kind of gains, and the number in them."""
_VERIFIED = ("verified on", "settled")


def sent_heads(updates: Sequence[Update], law: AnyController, command: str, small: DisplayUnit) -> tuple[str, ...]:
    """Make the heads of the table: those for which there is something to show; `command` is the command's unit."""
    zone = (f"dead zone, {small.name}",) if any(each.setting.tolerance for each in updates) else ()
    gains: tuple[str, ...] = ()
    if any(each.setting.gains for each in updates):
        own = gains_of(law)
        notch = ("notch, Hz",) if hasattr(own, "notch_hz") else ()
        gains = (*_SCALED[type(own)], *notch, f"feedforward, m{command}")
    verified = (*_VERIFIED, f"worst error, {small.name}", "Ms") if any(each.verification for each in updates) else ()
    return "after, s", *zone, *gains, *verified


def sent_texts(update: Update, heads: Sequence[str], law: AnyController, small: DisplayUnit) -> tuple[str, ...]:
    """Make the texts of an update, in the order of `heads`; gains relative to the machine's own."""
    texts = {heads[0]: _seconds(update.data_time), **_setting(update, law, small), **_verification(update, small)}
    return tuple(next((text for name, text in texts.items() if head.startswith(name)), "-") for head in heads)


def _seconds(time: float) -> str:
    return f"{time:.0f}" if time >= 10.0 or time == round(time) else f"{time:.3g}"


def _setting(update: Update, law: AnyController, small: DisplayUnit) -> dict[str, str]:
    setting = update.setting
    texts = {"dead zone": f"{setting.tolerance * small.factor:.4g}" if setting.tolerance else "-"}
    if setting.gains is None:
        return texts
    own = gains_of(law)
    for head, name in _SCALED[type(own)].items():
        texts[head] = _relative(getattr(setting.gains, name), getattr(own, name))
    texts["notch"] = _notch(setting.gains)
    texts["feedforward"] = f"{1e3 * setting.gains.feedforward:+.2f}"
    return texts


def _relative(new: float, own: float) -> str:
    """A gain over the machine's own; as it is where that is zero."""
    return f"x {new / own:.2f}" if own else f"{new:.3g}" if new else "-"


def _notch(gains: AnyGains) -> str:
    hz = getattr(gains, "notch_hz", 0.0)
    return f"{hz:.2f}" if hz else "-"


def _verification(update: Update, small: DisplayUnit) -> dict[str, str]:
    made = update.verification
    if made is None:
        return {}
    members, settled = f"{made.members} machines", f"{100.0 * made.settled:.1f} %"
    worst = f"{made.tail * small.factor:.{1 if made.tail * small.factor >= 0.1 else 4}f}"
    return {**dict(zip(_VERIFIED, (members, settled), strict=True)), "worst error": worst, "Ms": f"{made.Ms:.2f}"}
