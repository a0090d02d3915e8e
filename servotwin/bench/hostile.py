"""Is the edge safe from its twin? Random machines, and twins that are silent, lie, repeat themselves or send anything.

The machines are those of the redesign's table: stiffness within 15 %, damping 50 %, back-EMF and masses 10 %, gaps from
0 to 60 deg, steps of 0.1 to 2.5 mm; half with up to 0.1 V of input bias, half with Coulomb friction worth as much. The
fallback set is the published controller without integral action. What the loop does under it, on machines of other
seeds, is the band that it must then stay in whatever the twin sends.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.bench.hostiletwin import HostileTwin, Kind
from servotwin.control.controller import Controller
from servotwin.cosim.driver import Cosimulation, simulation_of
from servotwin.edge.limits import Limits
from servotwin.edge.parameters import gains_of
from servotwin.edge.settings import Supervision
from servotwin.edge.verdict import FallbackSet
from servotwin.edge.watch import WatchSettings
from servotwin.hybrid.automaton import Array
from servotwin.messages import Band, Cause, Reason
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.scenario import Scenario
from servotwin.scenariofile import Recording
from servotwin.simulation import Run
from servotwin.twin.settings import TwinSettings

RATE = 1000.0  # Hz, ticks and records
PERIOD = 20.0  # s of the reference's square wave
SETTLING = 4.0  # s
DURATION = 100.0  # s
SILENCE = 15.0  # s
MARGIN = WatchSettings().margin


KINDS = (Kind.SILENT, Kind.LIES_HIGH, Kind.LIES_LOW, Kind.REPLAYS)


@dataclass(frozen=True)
class Case:
    """One machine.

    Attributes
    ----------
    servo : Servo
    gap, theta_d0 : float
        rad.
    step : float
        m, amplitude of the square wave.
    input_bias, friction : float
        V, N m; one of them is zero.
    """

    servo: Servo
    gap: float
    theta_d0: float
    step: float
    input_bias: float
    friction: float


def case(seed: int) -> Case:
    """The machine of a seed."""
    draw = random.Random(seed)
    servo = Servo.preset("paper").replace(sample_rate=RATE)
    spread = {"k": 0.15, "c": 0.5, "k_B": 0.1, "m": 0.1}
    plant = {name: getattr(servo, name) * (1.0 + draw.uniform(-width, width)) for name, width in spread.items()}
    gap = math.radians(draw.uniform(0.0, 60.0))
    step = math.exp(draw.uniform(math.log(1e-4), math.log(2.5e-3)))
    biased, size = draw.random() < 0.5, draw.uniform(-0.1, 0.1)
    friction = 0.0 if biased else abs(size) * servo.k_T / servo.R
    return Case(servo.replace(**plant), gap, draw.uniform(-0.5, 0.5) * gap, step, size if biased else 0.0, friction)


def calm(servo: Servo) -> Controller:
    """The fallback's controller."""
    return servo.controller.replace(Ki=0.0)


@dataclass(frozen=True)
class Outcome:
    """What happened to one machine.

    Attributes
    ----------
    kind : Kind
    worst : float
        Largest settled error, in the band's.
    outside : float
        s, longest stretch outside of what the edge's watch allows.
    recovered : bool
        Whether every step that began after the last fallback ended inside the band.
    applied : int
        Updates put in force.
    fallbacks : tuple of Cause
    refused : Counter of Reason
    """

    kind: Kind
    worst: float
    outside: float
    recovered: bool
    applied: int
    fallbacks: tuple[Cause, ...]
    refused: Counter[Reason]


def endure(count: int, band: Band, kinds: Sequence[Kind] = KINDS, first: int = 0) -> tuple[Outcome, ...]:
    """`count` machines, the kinds of twins in turn."""
    return tuple(endured(first + k, kinds[k % len(kinds)], band) for k in range(count))


def certified(seeds: Iterable[int]) -> Band:
    """The band that the fallback set keeps to on the machines of these seeds: worst error, energies and effort."""
    errors, efforts = [], []
    for seed in seeds:
        run = _cosimulated(case(seed), Kind.NONE, None, seed)[1]
        errors.append(_settled(run, run.reference - run.position))
        efforts.append(_settled(run, run.voltage))
    largest = max(float(np.abs(error).max()) for error in errors)
    return Band(largest, max(map(_rms, errors)), max(map(_rms, efforts)), SETTLING)


def endured(seed: int, kind: Kind, band: Band) -> Outcome:
    """The machine of a seed with a twin of a kind."""
    loop, run = _cosimulated(case(seed), kind, band, seed)
    error = np.abs(_settled(run, run.reference - run.position)) / band.error
    last = max((fallback.sample for fallback in loop.fallbacks), default=0) / RATE
    return Outcome(
        kind,
        float(error.max()),
        max(map(_longest, error > MARGIN)) / RATE,
        bool(np.all(error[math.ceil(2.0 * last / PERIOD) :] <= MARGIN)),
        sum(receipt.applied for receipt in loop.receipts),
        tuple(fallback.cause for fallback in loop.fallbacks),
        Counter(receipt.reason for receipt in loop.receipts if not receipt.applied),
    )


def scenario(machine: Case, band: Band | None, seed: int) -> Scenario:
    """The machine under supervision, held to a band; None: it is on its own."""
    limits = Limits(
        maximum=2e-4 if band is None else band.error / 1.5,
        patience_s=1.0,
        gain_factor=2.5,
        integral_factor=0.05,
        gain_step=2.0,
        feedforward=0.1,
    )
    fallback = FallbackSet(0.0, gains_of(calm(machine.servo)), band, SILENCE)
    return Scenario(
        machine.servo,
        DURATION,
        seed,
        reference=SquareWave(machine.step, PERIOD),
        gap=machine.gap,
        theta_d0=machine.theta_d0,
        controller=calm(machine.servo),
        recording=Recording(RATE, window=1.0, pre_trigger=0.0, limits=limits),
        twin=TwinSettings(policy="paper", k_dz=0.0),
        supervision=None if band is None else Supervision(fallback),
        input_bias=machine.input_bias,
        friction=machine.friction,
    )


def _cosimulated(machine: Case, kind: Kind, band: Band | None, seed: int) -> tuple[Cosimulation, Run]:
    setting = scenario(machine, band, seed)
    servo = machine.servo
    own = gains_of(servo.controller)
    twin = HostileTwin(setting.name, kind, own, servo.p, machine.gap, random.Random(f"{kind} {seed}"))
    plant = simulation_of(setting)
    loop = Cosimulation(setting, plant, twin=twin)
    while not loop.done:
        loop.advance()
    return loop, plant.run()


def _settled(run: Run, signal: Array) -> Array:
    """(steps, samples): from `SETTLING` after each step of the reference to the next one."""
    half = round(0.5 * PERIOD * run.sample_rate)
    return signal[: len(signal) // half * half].reshape(-1, half)[:, round(SETTLING * run.sample_rate) :]


def _rms(signal: Array) -> float:
    """Of the worst step."""
    return math.sqrt(float(np.max(np.mean(signal**2, axis=1))))


def _longest(outside: Sequence[bool]) -> int:
    """Samples of the longest stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], np.asarray(outside, dtype=int), [0]))))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
