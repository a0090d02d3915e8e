"""Runs beyond the paper: every policy on Fig 15's wear, clean, in Fig 16's noise, and with an input bias."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.redesign.registry import policy_of
from servotwin.reproduction.measures import DEFINITIONS as MEASURES
from servotwin.reproduction.measures import TAIL, Array, between, tail
from servotwin.reproduction.runs import Trace
from servotwin.reproduction.twin_runs import NOISY, SAMPLED, SettingOrigin, TwinRun, run_twin
from servotwin.twin.settings import TwinSettings

POLICIES = ("paper", "margin", "hysteresis", "certified")
ALONE = "fallback set alone"  # the certified loop's first setting, never updated
CONTESTANTS = (*POLICIES, ALONE)
_TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class LoopCondition:
    """A packaged scenario, and a bias (V) on the motor's input."""

    scenario: str
    input_bias: float = 0.0


CLEAN, NOISE, BIASED = LoopCondition(SAMPLED), LoopCondition(NOISY), LoopCondition(SAMPLED, 0.05)


@dataclass(frozen=True, slots=True)
class PolicyJob:
    """One policy in one condition, for its first `duration` s.

    All policies share the machine, its noise, the link and the estimator (ours, with its defaults). Windows are those
    of the scenario; under "certified" they are those of that policy's own scenario, because its loop is calmer.
    `ALONE` is "certified" with its twin switched off; the difference between the two shows the benefit of the updates.
    """

    preset: str
    policy: str
    condition: LoopCondition
    duration: float = 200.0

    def scenario_to_run(self) -> st.Scenario:
        """Vary the packaged scenario."""
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

    def run(self) -> PolicyOutcome:
        """Co-simulate and measure; the outcome of a policy that cannot design for this machine is its reason."""
        scenario = self.scenario_to_run()
        reason = _design_refusal(scenario)
        if reason:
            return PolicyOutcome(self.policy, reason)
        run = run_twin(scenario)
        return PolicyOutcome(self.policy, "", run, measured_steps(run), measured_total(run))


@dataclass(frozen=True, slots=True)
class PolicyStep:
    """One step under one policy.

    Attributes
    ----------
    begin : float
        s.
    gap : float
        rad, total, at the step's end.
    settled : bool
        As in `measures`.
    error : float
        m, largest absolute error of the last `TAIL` seconds.
    overshoot : float
        Largest distance of the position beyond the reference, in sizes of the step; 0: none.
    settling : float
        s, as in `measures`; inf where the position is outside the band at the end.
    """

    begin: float
    gap: float
    settled: bool
    error: float
    overshoot: float
    settling: float


@dataclass(frozen=True, slots=True)
class PolicyTotal:
    """The whole run.

    Attributes
    ----------
    voltage, voltage_at_rest : float
        V rms: of the whole run, and of the last `TAIL` seconds of every step.
    travel : float
        Turns of the motor in both directions, added up.
    estimates, windows : int
        Windows whose estimate was accepted, and all.
    updates, fallbacks : int
        Updates put in force, and changes to the fallback set.
    """

    voltage: float
    voltage_at_rest: float
    travel: float
    estimates: int
    windows: int
    updates: int
    fallbacks: int


@dataclass(frozen=True, eq=False)
class PolicyOutcome:
    """Outcome of one policy. `refused`: reason for which it designs nothing; then the rest is empty."""

    policy: str
    refused: str = ""
    run: TwinRun | None = None
    steps: tuple[PolicyStep, ...] = ()
    total: PolicyTotal | None = None


def _design_refusal(scenario: st.Scenario) -> str:
    """Reason for which the scenario's policy cannot design for its machine; empty where it can."""
    try:
        policy_of(scenario.model, scenario.twin)
        scenario.agent_settings()
    except InvalidInput as error:
        return str(error)
    return ""


def measured_steps(run: TwinRun) -> tuple[PolicyStep, ...]:
    """Measure every step."""
    trace = run.trace
    error = trace.reference - trace.position
    return tuple(
        PolicyStep(
            begin=step.begin,
            gap=step.gap_end,
            settled=step.settled,
            error=float(np.abs(error[tail(trace.time, step.end)]).max()),
            overshoot=overshoot(trace, step.begin, step.end),
            settling=step.settling_time,
        )
        for step in trace.steps
    )


def overshoot(trace: Trace, begin: float, end: float) -> float:
    """Largest distance of the position beyond a stretch's reference, in sizes of its step."""
    part = between(trace.time, begin, end)
    goal, position = float(trace.reference[part][0]), trace.position[part]
    size = goal - float(position[0])
    return max(0.0, float(((position - goal) / size).max())) if size else 0.0


def measured_total(run: TwinRun) -> PolicyTotal:
    """Measure the whole run."""
    trace = run.trace
    rests = [trace.voltage[tail(trace.time, step.end)] for step in trace.steps]
    origins = [change.origin for change in run.changes]
    return PolicyTotal(
        voltage=_rms(trace.voltage),
        voltage_at_rest=_rms(np.concatenate(rests)) if rests else math.nan,
        travel=float(np.abs(np.diff(trace.theta_m)).sum()) / _TURN,
        estimates=sum(one.ok for one in run.estimates),
        windows=len(run.estimates),
        updates=origins.count(SettingOrigin.UPDATE),
        fallbacks=origins.count(SettingOrigin.FALLBACK),
    )


def worst(steps: Sequence[PolicyStep], name: str) -> float:
    """Largest `name` of all steps; NaN without any."""
    return max((float(getattr(step, name)) for step in steps), default=math.nan)


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


DEFINITIONS = {
    **{word: MEASURES[word] for word in ("settled", "settling time")},
    "error left": f"the largest distance of the true position from the reference over the last {TAIL:g} s of a step",
    "overshoot": "the largest distance of the position beyond the reference, in sizes of the step",
    "voltage at rest": f"root mean square over the last {TAIL:g} s of all steps",
    "motor travel": "turns of the motor in both directions, added up",
}
