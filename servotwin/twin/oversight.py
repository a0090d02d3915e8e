"""Oversight by engineers: holds, approvals and earlier settings that are sent again. An optional part, pure.

A twin that nobody oversees is as if this part were not there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from servotwin.messages import Setting, Update, WindowMessage
from servotwin.messages.acts import Act, ActKind
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.policy import Evidence, Policy, Redesign
from servotwin.twin.lookups import VerificationRequest

_STABLE = 0.5
"""Share of its validity for which a proposal stays, so that it can be read: then a newer one takes its place."""


class Proposal(Struct, frozen=True):
    """An update that waits for its approval, without its version and base; `gap`: rad, for which it was made.

    `verification`: what a setting that was looked up still needs once it is sent.
    """

    update: Update
    gap: float | None
    verification: VerificationRequest | None = None


class Oversight(Struct, frozen=True):
    """Part of the twin's state that belongs to the acts of engineers.

    Attributes
    ----------
    held : str
        Who holds the machine and why: no new version is sent; empty: nobody does.
    ask_first : bool
        New versions wait for an approval.
    proposal : Proposal or None
        The one that waits.
    again : Act or None
        Roll back that is carried out with the next window.
    """

    held: str = ""
    ask_first: bool = False
    proposal: Proposal | None = None
    again: Act | None = None

    def without_proposal(self) -> Oversight:
        """Copy in which nothing waits for an approval."""
        return replace(self, proposal=None)

    def proposes_anew(self, message: WindowMessage) -> bool:
        """True where a redesign of this window takes the place of what waits, or nothing waits."""
        if self.proposal is None or self.proposal.update.window[0] != message.boot:
            return True
        waiting = self.proposal.update
        return message.start >= waiting.data_time + _STABLE * (waiting.not_after - waiting.data_time)


class ActDecision(NamedTuple):
    """Oversight after an act; the reason for which it was refused; the proposal that it approved."""

    oversight: Oversight
    refused: str = ""
    approved: Proposal | None = None


def decide_act(
    oversight: Oversight, act: Act, newest: tuple[str, float] | None, known: dict[int, Setting], policy: Policy
) -> ActDecision:
    """Carry out an act on the oversight of a twin.

    Parameters
    ----------
    oversight : Oversight
    act : Act
    newest : (str, float) or None
        Boot and start (s) of the newest window that was processed.
    known : dict of int to Setting
        Setting of each version.
    policy : Policy
    """
    match act.act:
        case ActKind.HOLD:
            return ActDecision(replace(oversight, held=act.sentence, proposal=None, again=None))
        case ActKind.RELEASE:
            return ActDecision(replace(oversight, held="", again=None), "" if oversight.held else "nobody holds it")
        case ActKind.ASK_FIRST:
            return ActDecision(replace(oversight, ask_first=True))
        case ActKind.ASK_NO_MORE:
            return ActDecision(replace(oversight, ask_first=False, proposal=None))
        case ActKind.ROLL_BACK:
            why = _no_way_back(act, known, policy)
            back = replace(oversight, held=act.sentence, proposal=None, again=act)
            return ActDecision(oversight, why) if why else ActDecision(back)
        case ActKind.APPROVE:
            why = _not_approvable(oversight, act, newest)
            if why:
                return ActDecision(oversight, why)
            return ActDecision(replace(oversight, proposal=None), approved=oversight.proposal)


def _no_way_back(act: Act, known: dict[int, Setting], policy: Policy) -> str:
    if act.version is None and _certified(policy) is None:
        return "the policy has no fallback set: name a version"
    if act.version is not None and act.version not in known:
        versions = ", ".join(map(str, sorted(known))) or "none"
        return f"the setting of version {act.version} is not known; known are {versions}"
    return ""


def _not_approvable(oversight: Oversight, act: Act, newest: tuple[str, float] | None) -> str:
    if oversight.proposal is None:
        return "no proposal waits"
    waiting = oversight.proposal.update
    if waiting.window != act.window:
        return f"another proposal waits by now, of window {waiting.window[1]}"
    if newest is None or newest[0] != waiting.window[0]:
        return "the edge has started again since: the next window brings a new proposal"
    if newest[1] >= waiting.not_after:
        return "it has expired: the next window brings a new proposal"
    return ""


def sent_again(policy: Policy, evidence: Evidence, act: Act, known: dict[int, Setting]) -> Redesign:
    """Redesign that sends an earlier setting, or the fallback set, verified once more where the policy verifies."""
    certified = _certified(policy)
    if act.version is None:
        return (
            Redesign(None, math.nan, "no fallback set")
            if certified is None
            else certified.fall_back(evidence, act.sentence)
        )
    setting = known.get(act.version)
    if setting is None:
        return Redesign(None, math.nan, f"the setting of version {act.version} is no longer known")
    if certified is None:
        return Redesign(setting, evidence.estimate.gap, "")
    found = certified.confirm_again(evidence, setting)
    if found.setting is None:
        return Redesign(None, math.nan, f"version {act.version} is not sent again: {found.reason}")
    return found


def _certified(policy: Policy) -> CertifiedPolicy | None:
    if isinstance(policy, TablePolicy):
        return policy.policy
    return policy if isinstance(policy, CertifiedPolicy) else None
