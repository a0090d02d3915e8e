"""Endurance of the edge: random machines with twins that are silent, wrong, repetitive or random.

The machines are those that the certified policy's default uncertainty stands for: stiffness within 15 %, damping 50 %,
back-EMF and masses 10 % of the model, gaps from 0 to 60 deg, steps of 0.1 to 2.5 mm, input bias up to 0.1 V either way.
Others have undeclared Coulomb friction of the same size instead. Edge and twin know the model only. The fallback
set, its band and the limits are those of every scenario with that policy.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from benchmarks.hostiletwin import HostileTwin, TwinFault
from servotwin.commissioning.edge_settings import Recording
from servotwin.cosim.driver import Cosimulation
from servotwin.cosim.machine import SimulatedMachine, simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.watch import WatchSettings
from servotwin.hybrid.automaton import Array
from servotwin.messages import Band, Cause, Reason
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.simulation import Run
from servotwin.twin.settings import TwinSettings

RATE = 1000.0  # Hz, ticks and records
PERIOD = 20.0  # s of the reference's square wave
DURATION = 100.0  # s
MARGIN = WatchSettings().margin
KINDS = (TwinFault.SILENT, TwinFault.LIES_HIGH, TwinFault.LIES_LOW, TwinFault.REPLAYS)


@dataclass(frozen=True)
class HostileMachine:
    """One machine.

    Attributes
    ----------
    servo : Servo
    gap, theta_d0 : float
        rad.
    step : float
        m, size of the steps.
    input_bias, friction : float
        V, N m; one of them is zero.
    """

    servo: Servo
    gap: float
    theta_d0: float
    step: float
    input_bias: float
    friction: float


def model() -> Servo:
    """Make the model that edge and twin use."""
    return Servo.preset("paper").replace(sample_rate=RATE)


def case(seed: int, friction: bool = False) -> HostileMachine:
    """The machine of a seed; `friction`: with friction instead of an input bias."""
    draw, servo, known = random.Random(seed), model(), TwinSettings().uncertainty
    plant = {name: getattr(servo, name) * (1.0 + _within(draw, name, known)) for name in ("k", "c", "k_B", "m")}
    gap = draw.uniform(*known.gap)
    step = math.exp(draw.uniform(*map(math.log, known.step)))
    bias, theta_d0 = draw.uniform(*known.input_bias), draw.uniform(-0.5, 0.5) * gap
    disturbed = (0.0, abs(bias) * servo.k_T / servo.R) if friction else (bias, 0.0)
    return HostileMachine(servo.replace(**plant), gap, theta_d0, step, *disturbed)


def _within(draw: random.Random, name: str, known: Uncertainty) -> float:
    width = getattr(known, name)
    return draw.uniform(-width, width)


@dataclass(frozen=True)
class HostileOutcome:
    """Outcome of one machine.

    Attributes
    ----------
    kind : TwinFault
    case : HostileMachine
    worst : float
        Largest settled error, in the certified band's.
    outside : float
        s, longest stretch outside of the band.
    recovered : bool
        True if every step after the last fallback ended inside the watch's margin.
    applied : int
        Updates put in force.
    fallbacks : tuple of Cause
    refused : Counter of Reason
    """

    kind: TwinFault
    case: HostileMachine
    worst: float
    outside: float
    recovered: bool
    applied: int
    fallbacks: tuple[Cause, ...]
    refused: Counter[Reason]


@cache
def band(settings: TwinSettings | None = None) -> Band:
    """Band that is certified for the whole stated range."""
    fallback = scenario(case(0), 0, settings).agent_settings().supervision.fallback
    assert fallback is not None
    assert fallback.setting.band is not None
    return fallback.setting.band


def endured(
    seed: int,
    kind: TwinFault,
    settings: TwinSettings | None = None,
    friction: bool = False,
    duration: float = DURATION,
) -> HostileOutcome:
    """The machine of a seed with a twin of a kind, for so many seconds."""
    machine, certified = case(seed, friction), band(settings)
    loop, run = cosimulated(machine, kind, seed, settings, duration)
    error = np.abs(_settled(run, certified.settling)) / certified.error
    last = max((fallback.sample for fallback in loop.edge.fallbacks), default=0) / RATE
    return HostileOutcome(
        kind,
        machine,
        float(error.max()),
        max(map(_longest, error > 1.0)) / RATE,
        bool(np.all(error[math.ceil(2.0 * last / PERIOD) :] <= MARGIN)),
        sum(receipt.applied for receipt in loop.edge.receipts),
        tuple(fallback.cause for fallback in loop.edge.fallbacks),
        Counter(receipt.reason for receipt in loop.edge.receipts if not receipt.applied),
    )


def scenario(machine: HostileMachine, seed: int, settings: TwinSettings | None = None) -> Scenario:
    """Scenario with the model that edge and twin know."""
    return Scenario(
        model(),
        DURATION,
        seed,
        reference=SquareWave(0.5 * machine.step, PERIOD),
        gap=machine.gap,
        theta_d0=machine.theta_d0,
        recording=Recording(RATE),
        twin=settings or TwinSettings(),
        input_bias=machine.input_bias,
        friction=machine.friction,
    )


def cosimulated(
    machine: HostileMachine, kind: TwinFault, seed: int, settings: TwinSettings | None, duration: float
) -> tuple[Cosimulation, Run]:
    """The machine with a twin of a kind."""
    known = scenario(machine, seed, settings).replace(duration=duration)
    twin = HostileTwin.of(kind, known, machine.gap, random.Random(f"{kind} {seed}"))
    plant = SimulatedMachine(known, simulation_of(known, machine.servo))
    loop = Cosimulation(known, plant, twin=twin)
    while not loop.done:
        loop.advance()
    return loop, plant.run()


def _settled(run: Run, settling: float) -> Array:
    """(steps, samples) errors, m: from `settling` (s) after each step of the reference to the next one."""
    half, error = round(0.5 * PERIOD * run.sample_rate), run.reference - run.position
    return error[: len(error) // half * half].reshape(-1, half)[:, round(settling * run.sample_rate) :]


def _longest(outside: Sequence[bool]) -> int:
    """Samples of the longest stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], np.asarray(outside, dtype=int), [0]))))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
