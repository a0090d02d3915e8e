"""A setting that the edge has already: sent again only where it tells the edge another gap. Pure."""

from __future__ import annotations

from servotwin.messages import Setting
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.twin.state import TwinState

IN_FORCE = (
    "the setting is in force already, and the estimate is within its standard deviation of the gap that it was sent for"
)


def unless_in_force(state: TwinState, evidence: Evidence, redesign: Redesign) -> Redesign:
    """Return a redesign, without its setting where this says nothing new.

    An edge learns from a version which gap it was made for, and its window filter judges by that; so an equal setting
    is sent too, until the edge has the newest version, and whenever the estimate leaves the gap of that version by more
    than its standard deviation (`std_total`, with the model's floor).
    """
    setting, told, versions = redesign.setting, evidence.tuned_for, state.versions
    if setting is None or told is None or redesign.certificate is not None or redesign.to_verify is not None:
        return redesign
    newest = versions.pending is None and versions.in_force == versions.issued
    # An estimate or a gap that is NaN agrees with nothing.
    agrees = abs(evidence.estimate.gap - told) <= evidence.estimate.std_total
    if newest and agrees and _changes_nothing(setting, evidence.setting):
        return Redesign(None, redesign.gap, IN_FORCE)
    return redesign


def _changes_nothing(setting: Setting, now: Setting | None) -> bool:
    """True where a setting is the one in force; without gains it leaves those as they are."""
    if now is None:
        return False
    return setting == now or (setting.gains is None and setting == now.with_gains(None))
