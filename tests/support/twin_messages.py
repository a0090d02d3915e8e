"""Messages, a fake estimator and a policy of one line, for tests of the twin."""

import numpy as np

from servotwin import messages
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.window import Window
from servotwin.messages import (
    Reason,
    Receipt,
    Setting,
    pack_channel,
    pack_finely,
)
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.twin import Twin

PITCH = 3e-4


def window_message(sequence=0, start=0.0, boot="boot-1", servo="axis", version=0, channels=None):
    rng = np.random.default_rng(sequence)
    channels = channels or tuple(
        pack_channel(name, unit, rng.normal(size=50)) for name, unit in (("position", "m"), ("theta_m", "rad"))
    )
    return messages.WindowMessage(
        servo, boot, sequence, start, 100.0, channels, (), version, "model", "test", messages.checksum(channels)
    )


def known_gap(window: Window, _expected: Expectation) -> GapEstimate:
    """A fake estimator: the gap grows by 0.01 rad/s."""
    gap = 0.01 * window.start
    return GapEstimate(gap, 0.0, 0.0, (gap, gap), GapStatus.OK, window.mid_time)


class Rule:
    """A policy of one line."""

    needs_estimate = True

    def __init__(self, rule):
        self.rule, self.consulted = rule, []

    def redesign(self, evidence: Evidence) -> Redesign:
        self.consulted.append(evidence)
        return self.rule(evidence)


def eq_21() -> Rule:
    return Rule(lambda evidence: Redesign(Setting(PITCH * evidence.estimate.gap), evidence.estimate.gap, ""))


def make(estimator=known_gap, **settings):
    twin = twin_of(estimator, eq_21(), TwinSettings(**settings))
    return twin, twin.log


def twin_of(estimator, policy, settings: TwinSettings | None = None, **parts) -> Twin:
    return Twin("axis", TwinModel(estimator, policy, settings or TwinSettings(), **parts))


def receipt(update, reason=Reason.APPLIED, in_force=None, boot="boot-1"):
    in_force = update.version if in_force is None else in_force
    return Receipt("axis", update.version, reason is Reason.APPLIED, 10, reason, in_force, boot)


def message_of(window: Window, sequence: int = 1, **changes) -> messages.WindowMessage:
    """Message of a window, with theta_m packed finely; `changes`: version, reason, boot, start."""
    channels = []
    for name, samples in window.channels.items():
        unit = {"theta_m": "rad", "voltage": "V"}.get(name, "m")
        packed = pack_finely(name, unit, samples) if name == "theta_m" else (pack_channel(name, unit, samples),)
        channels += packed
    told = {"version": 0, "reason": "reference", "boot": "b", **changes}
    return messages.WindowMessage(
        "axis",
        told["boot"],
        sequence,
        told.get("start", window.start),
        window.sample_rate,
        tuple(channels),
        (),
        told["version"],
        "m",
        told["reason"],
        messages.checksum(channels),
    )
