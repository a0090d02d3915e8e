"""Beyond the paper: the policies side by side on Fig 15's wear, clean, in Fig 16's noise, and with an input bias."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.reproduction.inforce import Origin
from servotwin.reproduction.loops import NOISY, SAMPLED, Record, record
from servotwin.reproduction.measures import TAIL, Array, between, tail
from servotwin.reproduction.runs import Trace
from servotwin.twin.policies import policy_of
from servotwin.twin.settings import TwinSettings

POLICIES = ("paper", "margin", "hysteresis", "certified")
ALONE = "fallback set alone"  # where the certified loop begins, and nobody who updates it
CONTESTANTS = (*POLICIES, ALONE)
TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Condition:
    """A packaged scenario, and a bias (V) on the motor's input."""

    scenario: str
    input_bias: float = 0.0


CLEAN, NOISE, BIASED = Condition(SAMPLED), Condition(NOISY), Condition(SAMPLED, 0.05)


@dataclass(frozen=True, slots=True)
class PolicyJob:
    """One policy in one condition, for `duration` s of it; the wear is that of the whole scenario.

    The machine, its noise, the link and the estimator (ours, with its defaults) are the same for all; windows are as
    the scenario says, and those of "certified" as that policy's own scenario has them, because its loop is calmer.
    `ALONE` is "certified" with its twin switched off: against it one sees what the updates are worth.
    """

    preset: str
    policy: str
    condition: Condition
    duration: float = 200.0

    def described(self) -> st.Scenario:
        """The scenario."""
        packaged = st.Scenario.preset(self.condition.scenario).with_servo(st.Servo.preset(self.preset))
        alone = self.policy == ALONE
        policy = "certified" if alone else self.policy
        window = None if policy == "certified" else packaged.recording.window
        return packaged.replace(
            duration=self.duration,
            recording=replace(packaged.recording, window=window, fine_angle=True),
            twin=TwinSettings(policy=policy, enabled=not alone),
            input_bias=self.condition.input_bias,
        )

    def run(self) -> Outcome:
        """Co-simulate and measure; a policy that cannot design for this machine says so instead."""
        scenario = self.described()
        why = refusal(scenario)
        if why:
            return Outcome(self.policy, why)
        kept = record(scenario)
        return Outcome(self.policy, "", kept, measured(kept), summed(kept))


@dataclass(frozen=True, slots=True)
class StepRow:
    """One step under one policy.

    Attributes
    ----------
    begin : float
        s.
    gap : float
        rad, total, at the step's end.
    settled : bool
        As everywhere in the reproduction.
    error : float
        m, the largest of the last `TAIL` seconds.
    overshoot : float
        How far the position goes beyond the reference, in sizes of the step; 0: not at all.
    settling : float
        s, as everywhere in the reproduction; inf where it leaves the band to the end.
    """

    begin: float
    gap: float
    settled: bool
    error: float
    overshoot: float
    settling: float


@dataclass(frozen=True, slots=True)
class Total:
    """The whole run.

    Attributes
    ----------
    voltage, voltage_at_rest : float
        V rms: of the whole run, and of the last `TAIL` seconds of every step.
    travel : float
        Turns that the motor makes, to and fro.
    estimates, windows : int
        Windows whose estimate was accepted, and all.
    updates, fallbacks : int
        Updates put in force, and how often the edge left them for its fallback set.
    """

    voltage: float
    voltage_at_rest: float
    travel: float
    estimates: int
    windows: int
    updates: int
    fallbacks: int


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of one policy; `refused` says why nothing did, and then the rest is empty."""

    policy: str
    refused: str = ""
    record: Record | None = None
    steps: tuple[StepRow, ...] = ()
    total: Total | None = None


def refusal(scenario: st.Scenario) -> str:
    """Why the scenario's policy cannot design for its machine; empty where it can."""
    try:
        policy_of(scenario.model, scenario.twin)
        scenario.agent_settings()
    except InvalidInput as error:
        return str(error)
    return ""


def measured(kept: Record) -> tuple[StepRow, ...]:
    """Every step."""
    trace = kept.trace
    error = trace.reference - trace.position
    return tuple(
        StepRow(
            step.begin,
            step.gap_end,
            step.settled,
            float(np.abs(error[tail(trace.time, step.end)]).max()),
            overshoot(trace, step.begin, step.end),
            step.settling_time,
        )
        for step in trace.steps
    )


def overshoot(trace: Trace, begin: float, end: float) -> float:
    """How far the position goes beyond a stretch's reference, in sizes of its step from the position at its begin."""
    part = between(trace.time, begin, end)
    goal, position = float(trace.reference[part][0]), trace.position[part]
    size = goal - float(position[0])
    return max(0.0, float(((position - goal) / size).max())) if size else 0.0


def summed(kept: Record) -> Total:
    """The whole run's measures."""
    trace = kept.trace
    rests = [trace.voltage[tail(trace.time, step.end)] for step in trace.steps]
    origins = [change.origin for change in kept.changes]
    return Total(
        voltage=_rms(trace.voltage),
        voltage_at_rest=_rms(np.concatenate(rests)) if rests else math.nan,
        travel=float(np.abs(np.diff(trace.theta_m)).sum()) / TURN,
        estimates=sum(one.ok for one in kept.estimates),
        windows=len(kept.estimates),
        updates=origins.count(Origin.UPDATE),
        fallbacks=origins.count(Origin.FALLBACK),
    )


def worst(steps: Sequence[StepRow], name: str) -> float:
    """The largest `name` of all steps; NaN without any."""
    return max((float(getattr(step, name)) for step in steps), default=math.nan)


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


DEFINITIONS = {
    "error left": f"the largest distance of the true position from the reference over the last {TAIL:g} s of a step",
    "overshoot": "how far the position goes beyond the reference, in sizes of the step",
    "voltage at rest": f"root mean square over the last {TAIL:g} s of all steps",
    "motor travel": "turns of the motor to and fro, all added up",
}
