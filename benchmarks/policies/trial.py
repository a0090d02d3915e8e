"""One machine under one policy: 10 s of rest, a step, 60 s after it, and windows of rest from which it may learn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.policies.machines import NOISE, TrialMachine
from servotwin.control.controller import Controller
from servotwin.control.gains import with_gains
from servotwin.estimation.disturbance import disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Step
from servotwin.redesign.certified.assess import NEAR
from servotwin.redesign.design import Design
from servotwin.redesign.policy import Evidence, Policy
from servotwin.simulation import Run, Simulation

REST, DURATION, LAST = 10.0, 60.0, 10.0
UPDATES = (8.0, 30.0, 50.0)  # s, ends of the windows
WINDOW, DELAY = 2.0, 1.0
SPREAD = math.radians(0.05)
_RATES = {"noise": 5000.0}
_RATE = 500.0


class Scores(NamedTuple):
    """Measures of one run.

    Attributes
    ----------
    ripple : float
        m, half peak-to-peak of the true error over the last 10 s.
    tail : float
        m, largest abs(error) there.
    cost : float
        s, integral of abs(error) over the whole run, per step.
    overshoot : float
        Per step.
    settling : float
        s, last time at which the error exceeds 2 % of the step.
    voltage : float
        V rms over the last 10 s.
    travel : float
        rad/s, mean speed of the motor there, either way.
    position : float
        m, root mean square error there.
    scale, integral, width : float
        What was in force at the end: Kp and Ki in the model's own, tolerance in m.
    """

    ripple: float
    tail: float
    cost: float
    overshoot: float
    settling: float
    voltage: float
    travel: float
    position: float
    scale: float
    integral: float
    width: float


@dataclass(frozen=True)
class Contender:
    """A policy with the setting that runs before its first decision.

    Attributes
    ----------
    policy : Policy or None
        None: the start setting stays.
    start : Design
    """

    policy: Policy | None
    start: Design


def run_machine(machine: TrialMachine, block: str, model: Servo, competitor: Contender) -> Scores:
    """Run a machine under a policy.

    The policy gets the gap with an error of 0.05 deg (standard deviation), which it knows. It learns everything else
    from its windows: 2 s that end 2 s before the step, 20 and 40 s after it; its setting is in force a second later.
    """
    rng = np.random.default_rng(machine.seed)
    believed = max(0.0, machine.gap + SPREAD * rng.standard_normal())
    setting = _redesigned(competitor, Evidence(_estimate(believed)), competitor.start)
    simulation, told_for, rests = _simulation(machine, block, setting, rng), None, tuple[float, ...]()
    for end in UPDATES if competitor.policy is not None else ():
        simulation.advance(_sample(end, block))
        window = Window.from_run(simulation.run(), start=end - WINDOW, duration=WINDOW)
        measured = disturbance(window, model)
        evidence = Evidence(_estimate(believed), measured, None, setting.setting(), told_for, rests=rests)
        rests = (*rests, measured.bias) if measured.known else rests
        now = _redesigned(competitor, evidence, setting)
        told_for = believed
        if now != setting:
            simulation.advance(_sample(end + DELAY, block))
            simulation.set_controller(_law(now.pid, block), now.tolerance)
            setting = now
    simulation.advance(_sample(REST + DURATION, block))
    return scores(simulation.run(), machine.step, setting, model)


def scores(run: Run, step: float, setting: Design, model: Servo) -> Scores:
    """Measure a run with one step from the step on; state the setting at its end."""
    law, own = setting.pid, model.controller
    error = (run.reference - run.position)[round(REST * run.sample_rate) :]
    last = slice(-round(LAST * run.sample_rate), None)
    outside = np.flatnonzero(np.abs(error) > NEAR * step)
    return Scores(
        ripple=0.5 * float(np.ptp(error[last])),
        tail=float(np.abs(error[last]).max()),
        cost=float(np.abs(error).mean()) * DURATION / step,
        overshoot=max(0.0, -float(error.min())) / step,
        settling=0.0 if outside.size == 0 else float(outside[-1] / run.sample_rate),
        voltage=float(np.sqrt(np.mean(run.voltage[last] ** 2))),
        travel=float(np.abs(np.diff(run.theta_m[last])).sum()) / LAST,
        position=float(np.sqrt(np.mean(error[last] ** 2))),
        scale=law.Kp / own.Kp,
        integral=law.Ki / own.Ki,
        width=setting.tolerance,
    )


def _redesigned(competitor: Contender, evidence: Evidence, before: Design) -> Design:
    """Let the policy decide; return the setting after its decision."""
    if competitor.policy is None:
        return before
    made = competitor.policy.redesign(evidence)
    if made.setting is None:
        return before
    return Design(with_gains(before.controller, made.setting.gains), made.setting.tolerance)


def _estimate(gap: float) -> GapEstimate:
    interval = (max(0.0, gap - 2.0 * SPREAD), gap + 2.0 * SPREAD)
    return GapEstimate(gap, SPREAD, SPREAD, interval, GapStatus.OK, 0.0)


def _simulation(machine: TrialMachine, block: str, setting: Design, rng: np.random.Generator) -> Simulation:
    return Simulation(
        machine.servo,
        REST + DURATION,
        _law(setting.pid, block),
        reference=Step(machine.step, REST),
        gap=machine.gap,
        tolerance=setting.tolerance,
        theta_d0=machine.theta_d0,
        sample_rate=_RATES.get(block, _RATE),
        noise=NOISE if block == "noise" else None,
        seed=rng,
        input_bias=machine.input_bias,
        friction=machine.friction,
    )


def _law(controller: Controller, block: str) -> Controller:
    """Simulate continuously and exactly; with noise, sampled."""
    return controller.replace(sample_rate=_RATES.get(block))


def _sample(time: float, block: str) -> int:
    return round(time * _RATES.get(block, _RATE))
