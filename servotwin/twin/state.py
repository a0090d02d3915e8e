"""State of a twin: its knowledge of the servo and of the versions at its edge, as one frozen value, stored unchanged.

MessagePack with a tag that carries the schema's version, every float with all its bits, arrays as lists. The settings
are no part of the state: a twin that is restored under other settings uses those.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from servotwin.errors import InvalidInput
from servotwin.estimation.learning.wear import Wear
from servotwin.messages import Gains, Reason, Receipt, Setting, Update, WindowMessage, finite, needed_fields
from servotwin.messages.legacy import upgrade
from servotwin.redesign.certified.last_search import LastSearch
from servotwin.redesign.certified.verification import verification_of
from servotwin.redesign.design import decoded_part
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.twin.lookups import LookupState
from servotwin.twin.oversight import Oversight
from servotwin.twin.requests import Attempts, RequestState
from servotwin.twin.responses import ResponseState
from servotwin.twin.triage import TriageState
from servotwin.twin.untold_ratio import UntoldRatio

MAX_ENDED_BOOTS = 1000
"""Number of boots that a twin remembers: its state must stay bounded."""
MAX_SETTINGS = 16
"""Number of versions whose setting is remembered, besides the first one and the one in force."""
# Windows whose step is remembered.
_STEPS = 4


class Versions(Struct, frozen=True):
    """Parameter versions of one edge.

    Version numbers only rise. The edge swaps a version only for one that names it as its base; when the twin's view
    was out of date, the receipt says what is in force and the same parameters go out again on that base. Within a boot
    of the edge, parameters only move forward in the time of their window; a window of an earlier boot never sets any.

    Attributes
    ----------
    boot : str or None
        The edge's current boot; None: no message has come yet.
    in_force : int
        Newest version known to run at the edge.
    issued : int
        Highest version ever used for an update.
    pending : Update or None
        The newest update, while no receipt for it has come.
    data_time : float
        Sample time of the data of the newest update of this boot, s.
    ended_boots : tuple of str
        The last `MAX_ENDED_BOOTS` of them.
    root : int
        First version of the chain of updates that ends with the pending one; its base was in force.
    """

    boot: str | None = None
    in_force: int = 0
    issued: int = 0
    pending: Update | None = None
    data_time: float = -math.inf
    ended_boots: tuple[str, ...] = ()
    root: int = 0

    def has_ended(self, boot: str) -> bool:
        """True for a boot that is over."""
        return boot in self.ended_boots

    def noted(self, boot: str, in_force: int) -> Versions:
        """Note a boot and its version in force, as a message states them; a boot that is over changes nothing."""
        if self.has_ended(boot):
            return self
        now = self if boot == self.boot else self._rebooted(boot, in_force)
        in_force = max(now.in_force, in_force)
        return replace(now, in_force=in_force, issued=max(now.issued, in_force))

    def admits(self, window: WindowMessage) -> bool:
        """True where the window is newer than the data of every update so far."""
        return window.boot == self.boot and window.start > self.data_time

    def with_update(self, update: Update) -> Versions:
        """Make an update pending under the next version; its base is the version in force on its arrival."""
        return self._rebased(update) if self.pending is None else self._numbered(update, self.pending.version)

    def after_receipt(self, receipt: Receipt) -> tuple[Versions, Update | None]:
        """Return the versions after a receipt, and the update to send instead of the pending one.

        That is necessary when the edge refused the pending update for its base or number, or will refuse it because it
        refused an earlier one of the same chain.
        """
        now = self.noted(receipt.boot, receipt.parameter_version)
        pending = now.pending
        if self.has_ended(receipt.boot) or pending is None:
            return now, None
        if receipt.reason is Reason.FELL_BACK and receipt.version >= now.root:
            # Its data are from before the fallback: the next window's are not.
            return now.without_pending(), None
        if now._breaks(receipt, pending):
            rebased = now._rebased(pending)
            return rebased, rebased.pending
        if receipt.version != pending.version or receipt.reason is Reason.TOO_SOON:
            return now, None
        if receipt.reason is Reason.BASE_MISMATCH or now.in_force > pending.version:
            rebased = now._rebased(pending)
            return rebased, rebased.pending
        return now.without_pending(), None

    @property
    def current(self) -> tuple[int, ...]:
        """Version in force, and the pending one."""
        return self.in_force, *(() if self.pending is None else (self.pending.version,))

    def without_pending(self) -> Versions:
        """Copy without the pending update."""
        return replace(self, pending=None)

    def _rebooted(self, boot: str, in_force: int) -> Versions:
        ended = self.ended_boots if self.boot is None else (*self.ended_boots, self.boot)[-MAX_ENDED_BOOTS:]
        return replace(self, boot=boot, in_force=in_force, pending=None, data_time=-math.inf, ended_boots=ended)

    def _breaks(self, receipt: Receipt, pending: Update) -> bool:
        """True where the base of the pending update will never be in force.

        A twin with a backlog sends several updates before it reads the first receipt. If only the last receipt counted,
        the edge would refuse all of them until the twin has caught up.
        """
        follows = self.root <= receipt.version < pending.version and self.in_force < pending.base_version
        return follows and not receipt.applied and receipt.reason is not Reason.SUPERSEDED

    def _rebased(self, update: Update) -> Versions:
        """Make an update pending whose base is the version in force."""
        return replace(self._numbered(update, self.in_force), root=self.issued + 1)

    def _numbered(self, update: Update, base: int) -> Versions:
        version = self.issued + 1
        pending = replace(update, version=version, base_version=base)
        return replace(self, issued=version, data_time=update.data_time, pending=pending)


Settings = Mapping[int, Setting]
"""Setting of each known version."""


def noted_setting(known: Settings, version: int, setting: Setting, base: int, in_force: int = 0) -> dict[int, Setting]:
    """Add a setting to the known ones; where it has no gains it gets those of its base version.

    The oldest are dropped, but never the first one and the one in force.
    """
    before = known.get(base)
    if setting.gains is None and before is not None:
        setting = setting.with_gains(before.gains)
    after = {**known, version: setting}
    # The edge starts with version 0: later updates without gains go back to its gains.
    keep = {0, version, in_force, *sorted(after)[-MAX_SETTINGS:]}
    return {number: each for number, each in sorted(after.items()) if number in keep}


def draft_update(message: WindowMessage, evidence: Evidence, redesign: Redesign, validity: float) -> Update:
    """Make an update without version and base; it may be applied until `validity` (s) after the window's start."""
    assert redesign.setting is not None
    estimate = evidence.estimate
    low, high = estimate.interval
    return Update(
        servo=message.servo,
        version=1,
        base_version=0,
        window=(message.boot, message.sequence),
        data_time=message.start,
        gap=finite(estimate.gap),
        std=finite(estimate.std_total),
        interval=(finite(low), finite(high)),
        status=estimate.status.value,
        setting=redesign.setting,
        not_after=message.start + validity,
        verification=None if redesign.certificate is None else verification_of(redesign.certificate),
        needs=needed_fields(redesign.setting),
    )


class TwinState(Struct, frozen=True, tag="twin-state/2"):
    """State of the twin of one servo.

    Attributes
    ----------
    servo : str
    versions : Versions
    known : dict of int to Setting
        Setting of each version of the parameters, as far as it is known.
    wear : Wear
    attempts : Attempts
        Sendings of the pending update.
    tuned_for : float or None
        rad, gap of the last redesign.
    rests : tuple of float
        V, input biases that the last windows showed, the newest last.
    steps : tuple of float
        m, sizes of the reference's steps in the last windows, the newest last.
    first_step : float
        m, size of a step made before the first window, by the way to rest; 0: none is known.
    other_controller : int
        Windows in a row whose voltage is not that of the controller stated for them.
    other_drive : int
        Windows in a row, of those that tell, whose command moves the axis otherwise than stated.
    newest : (str, float) or None
        Boot and start (s) of the newest window that was processed.
    introduced : bool
        The edge introduces each boot by a hello, so that no window begins one: after a restore, windows come again of
        boots that ended before it and that the twin does not know.
    requests, triage, lookups, responses : RequestState, TriageState, LookupState, ResponseState, or None
        State of the optional parts; None: the twin has no such part.
    oversight : Oversight
        Effect of engineers' acts.
    ratio : UntoldRatio
        Windows that do not tell the gap from the transmission's ratio.
    search : LastSearch or None
        The last search for a verified setting.
    """

    servo: str
    versions: Versions
    known: dict[int, Setting]
    wear: Wear
    attempts: Attempts = Attempts()
    tuned_for: float | None = None
    requests: RequestState | None = None
    triage: TriageState | None = None
    lookups: LookupState | None = None
    rests: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    first_step: float = 0.0
    responses: ResponseState | None = None
    other_controller: int = 0
    newest: tuple[str, float] | None = None
    introduced: bool = False
    oversight: Oversight = Oversight()
    ratio: UntoldRatio = UntoldRatio()
    search: LastSearch | None = None
    other_drive: int = 0

    def with_sent(self, update: Update, now: float) -> TwinState:
        """Note the first sending of an update, with its setting: the receipt may get lost."""
        known = noted_setting(self.known, update.version, update.setting, update.base_version, self.versions.in_force)
        return replace(self, known=known, attempts=Attempts(now, 1))

    def with_step(self, step: float, way_to_rest: float) -> TwinState:
        """Note the step of the reference that a window shows, or the way to rest of one made before it; both m, 0:
        none."""
        if step > 0.0:
            return replace(self, steps=(*self.steps, step)[-_STEPS:])
        return self if self.steps or self.first_step else replace(self, first_step=way_to_rest)

    @property
    def usual_steps(self) -> tuple[float, ...]:
        """Sizes of the last steps, m.

        The first move of a machine that goes to and fro is half as long as the others: it counts only until one of
        these is known.
        """
        return self.steps or ((self.first_step,) if self.first_step else ())

    def is_of_other_boot(self, window: WindowMessage) -> bool:
        """True for a window of a boot that has ended, or was not introduced though the edge introduces each."""
        unknown = self.introduced and window.boot != self.versions.boot
        return unknown or self.versions.has_ended(window.boot)

    def has_overtaken(self, window: WindowMessage) -> bool:
        """True where a newer window was processed before this one, or it is not of the edge's current boot."""
        if self.is_of_other_boot(window):
            return True
        return self.newest is not None and window.boot == self.newest[0] and window.start < self.newest[1]


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(TwinState, dec_hook=decoded_part)


def encode_state(state: TwinState) -> bytes:
    """Encode a state; equal states give equal bytes."""
    return _encoder.encode(state)


def decode_state(servo: str, data: bytes) -> TwinState:
    """Decode the state of a servo, in this version's schema or the previous one.

    Raises
    ------
    InvalidInput
        The bytes are not such a state, or belong to another servo.
    """
    try:
        try:
            state = _decoder.decode(data)
        except msgspec.ValidationError:
            document = msgspec.msgpack.decode(data)
            if not isinstance(document, dict) or document.get("type") != "twin-state/1":
                raise
            state = msgspec.convert(_upgraded(document), TwinState, dec_hook=decoded_part)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError, LookupError, TypeError) as error:
        raise InvalidInput(f"the state of servo {servo!r} is not understood: {error}") from None
    if state.servo != servo:
        raise InvalidInput(f"the state of servo {servo!r} belongs to {state.servo!r}; each servo needs its own")
    return state


def oversight_within(servo: str, data: bytes) -> Oversight | None:
    """Read what engineers have set, without a proposal, from a state that is not understood as a whole.

    None where this part is not understood either, or belongs to another servo.
    """
    try:
        document = msgspec.msgpack.decode(data)
        if document["servo"] != servo:
            return None
        return msgspec.convert({**document.get("oversight", {}), "proposal": None}, Oversight, dec_hook=decoded_part)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError, LookupError, TypeError, AttributeError):
        return None


def _upgraded(old: dict[str, Any]) -> dict[str, Any]:
    """Convert a document of the previous schema, in which a known setting was a whole controller."""
    versions, wear, requests = old["versions"], old["wear"], old["requests"]
    known = {version: _setting(one) for version, one in old["known"].items() if one["tolerance"] is not None}
    return {
        "type": "twin-state/2",
        "servo": old["servo"],
        "versions": {
            "boot": versions["boot"],
            "in_force": versions["in_force"],
            "issued": versions["issued"],
            "pending": upgrade(versions["pending"]),
            "data_time": versions["newest"],
            "ended_boots": versions["earlier"],
            "root": versions.get("root", 0),
        },
        "known": known,
        "wear": {
            "previous": wear["previous"], "boot": wear["boot"], "arrived": wear["heard"], "state": wear["trend"],
        },
        "attempts": {"sent_at": old["sent_at"], "count": old["attempts"]},
        "tuned_for": old["tuned_for"],
        "requests": requests
        and {
            "pending": requests["pending"],
            "excitation": requests["memory"],
            "boot": requests["boot"],
            "serial": requests["serial"],
            "attempts": {"sent_at": requests["sent_at"], "count": requests["attempts"]},
        },
        "triage": old.get("watch"),
        "lookups": old.get("lookups"),
    }  # fmt: skip


def _setting(old: dict[str, Any]) -> dict[str, Any]:
    law = old["controller"]
    gains = None if law is None else {name: law[name] for name in Gains.__struct_fields__ if name in law}
    return {"tolerance": old["tolerance"], "gains": gains}
