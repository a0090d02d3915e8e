"""The runs with a twin in the loop (Figs 15 and 16): packaged scenarios, varied, run by co-simulation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import servotwin as st
from servotwin import messages
from servotwin.cosim import Loop
from servotwin.estimation import paper, whitened
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.window import Window
from servotwin.plant.signals import as_pieces
from servotwin.reproduction.inforce import Change, changes
from servotwin.reproduction.measures import Step
from servotwin.reproduction.runs import BIPOLAR, Square, Trace
from servotwin.twin.estimating import Estimator, estimator_of
from servotwin.twin.known import known_gap
from servotwin.twin.wear import Expectation

PUBLISHED, OURS = paper.METHOD, whitened.METHOD
SEEDS = (2023, 2024, 2025)  # of the noise; the first is the packaged scenario's
CONTINUOUS, SAMPLED, NOISY = "fig15", "fig15-sampled", "fig16"
Progress = Callable[[float], object]


@dataclass(frozen=True, slots=True)
class Estimated:
    """One estimate: when (s, middle of its window), what (rad, total gap), how sure (rad), and the truth then (rad).

    Where it is not OK, `gap` is what was believed already, or a bound.
    """

    time: float
    gap: float
    std: float
    interval: tuple[float, float]
    status: str
    reasons: tuple[str, ...]
    truth: float
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether it reached the controller."""
        return self.status == GapStatus.OK.value

    @property
    def error(self) -> float:
        """Estimate minus truth, rad."""
        return self.gap - self.truth


@dataclass(frozen=True, eq=False)
class Record:
    """What figures and claims need of a co-simulation.

    Attributes
    ----------
    trace : Trace
    estimates : tuple of Estimated
    applied : tuple of (float, float)
        When an update took effect and the change of the reference that its window began with, s.
    channel_samples, channel_bytes : tuple of int
        Samples and bytes of the motor's and the position's channel together, for each window.
    message_bytes : tuple of int
        Bytes of each whole window message as sent.
    quantisation : float
        Largest half step of the decoded position, m.
    updates : tuple of messages.Update
        What the twin sent.
    changes : tuple of Change
        What was in force at the edge, and since when.
    """

    trace: Trace
    estimates: tuple[Estimated, ...]
    applied: tuple[tuple[float, float], ...]
    channel_samples: tuple[int, ...]
    channel_bytes: tuple[int, ...]
    message_bytes: tuple[int, ...]
    quantisation: float
    updates: tuple[messages.Update, ...] = ()
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True, slots=True)
class LoopJob:
    """A packaged scenario with another servo, reference, seed, dead-zone gain or estimator.

    The scenarios are the paper's, and so is their estimator, with its settings; `OURS` is the default one with its
    defaults, and theta_m sent with 32 bits instead of 16; `exact` sends the true gap instead.
    """

    preset: str
    scenario: str = CONTINUOUS
    square: Square = BIPOLAR
    seed: int = SEEDS[0]
    k_dz: float = 1.0
    exact: bool = False
    method: str = PUBLISHED

    def described(self) -> st.Scenario:
        """The scenario."""
        packaged = st.Scenario.preset(self.scenario).with_servo(st.Servo.preset(self.preset))
        published = self.method == packaged.twin.method
        settings = packaged.twin.estimator if published else None
        return packaged.replace(
            reference=self.square.signal,
            recording=replace(packaged.recording, fine_angle=not published),
            seed=self.seed,
            twin=packaged.twin.replace(k_dz=self.k_dz, method=self.method, estimator=settings),
        )

    def run(self) -> Record:
        """Co-simulate and keep what is needed."""
        return record(self.described(), exact=self.exact)


@dataclass(frozen=True, slots=True)
class FamilyJob:
    """The steps of Fig 15's continuous run for a family of squares."""

    preset: str
    square: Square = BIPOLAR
    exact: bool = False

    def run(self) -> tuple[tuple[Step, ...], ...]:
        """One row of steps per member."""
        jobs = (LoopJob(self.preset, CONTINUOUS, member, exact=self.exact) for member in self.square.family)
        return tuple(job.run().trace.steps for job in jobs)


def record(scenario: st.Scenario, exact: bool = False, progress: Progress | None = None) -> Record:
    """Co-simulate a scenario, timing each estimate."""
    seconds: list[float] = []
    loop = st.cosimulate(scenario, progress, _timed(scenario, seconds, exact))
    return Record(
        trace=Trace.of(loop.run),
        estimates=_estimates(loop, seconds),
        applied=_applied(loop),
        channel_samples=tuple(sum(c.samples for c in _channels(w)) for w in loop.windows),
        channel_bytes=tuple(sum(len(c.data) for c in _channels(w)) for w in loop.windows),
        message_bytes=_window_bytes(loop),
        quantisation=max((_half_step(window) for window in loop.windows), default=0.0),
        updates=loop.updates,
        changes=changes(loop),
    )


def _timed(scenario: st.Scenario, seconds: list[float], exact: bool) -> Estimator:
    """The twin's own estimator, or one that knows the gap, with the wall time of each call noted."""
    known = known_gap(scenario.gap, scenario.duration)
    chosen = known if exact else estimator_of(scenario.servo, scenario.twin)

    def estimate(window: Window, expected: Expectation) -> st.GapEstimate:
        begin = time.perf_counter()
        found = chosen(window, expected)
        seconds.append(time.perf_counter() - begin)
        return found

    return estimate


def _estimates(loop: Loop, seconds: list[float]) -> tuple[Estimated, ...]:
    times = [one.time for one in loop.estimates]
    truths = as_pieces(loop.scenario.gap, loop.scenario.duration).value(times)
    return tuple(
        Estimated(one.time, one.gap, one.std_total, one.interval, one.status.value, one.reasons, float(truth), spent)
        for one, truth, spent in zip(loop.estimates, truths, seconds, strict=True)
    )


def _applied(loop: Loop) -> tuple[tuple[float, float], ...]:
    rate = loop.scenario.recording.sample_rate
    begins = {update.version: update.data_time for update in loop.updates}
    return tuple((receipt.sample / rate, begins[receipt.version]) for receipt in loop.applied)


def _channels(window: messages.Window) -> tuple[messages.Channel, ...]:
    """The two channels that the paper sends."""
    return tuple(c for c in window.channels if c.name in ("theta_m", "position"))


def _half_step(window: messages.Window) -> float:
    """Largest rounding error of the position as sent, m."""
    return max(c.scale / 2.0 for c in window.channels if c.name == "position")


def _window_bytes(loop: Loop) -> tuple[int, ...]:
    """Bytes of each window message, its first copy."""
    up = (m for m in loop.messages if m.direction == "up" and m.copy == 0)
    return tuple(len(m.data) for m in up if isinstance(m.message, messages.Window))
