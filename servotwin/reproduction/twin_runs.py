"""Runs with a twin in the loop (Figs 15 and 16) by co-simulation, and windows for the published estimator."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

import servotwin as st
from servotwin import messages
from servotwin.control.gains import gains_of
from servotwin.control.laws import filtered_pid
from servotwin.cosim import Loop
from servotwin.estimation import paper, whitened
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.window import Window
from servotwin.plant.signals import as_pieces
from servotwin.reproduction.measures import MeasuredStep
from servotwin.reproduction.runs import BIPOLAR, PERIOD, RATE, Square, Trace
from servotwin.twin.estimating import Estimator, estimator_of, known_gap

PUBLISHED, OURS = paper.METHOD, whitened.METHOD
SEEDS = (2023, 2024, 2025)  # of the noise; the first is the packaged scenario's
CONTINUOUS, SAMPLED, NOISY = "fig15", "fig15-sampled", "fig16"
Progress = Callable[[float], object]


@dataclass(frozen=True, slots=True)
class EstimateRecord:
    """One estimate: time of its window's middle (s), total gap, spread and interval (rad), the true gap then (rad).

    `seconds` is the wall time of the estimation. Where the status is not OK, `gap` is the prior or a bound.
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
        """True if the estimate reached the controller."""
        return self.status == GapStatus.OK.value

    @property
    def error(self) -> float:
        """Estimate minus truth, rad."""
        return self.gap - self.truth


class SettingOrigin(StrEnum):
    """Origin of a setting in force at the edge."""

    START = "start"
    UPDATE = "update"
    FALLBACK = "fallback"


@dataclass(frozen=True, slots=True)
class SettingChange:
    """A setting in force from `time` (s) on: dead-zone half-width (m) and gains."""

    time: float
    origin: SettingOrigin
    tolerance: float
    gains: messages.Gains


@dataclass(frozen=True, eq=False)
class TwinRun:
    """A co-simulation reduced to the needs of figures and claims.

    Attributes
    ----------
    trace : Trace
    estimates : tuple of EstimateRecord
    applied : tuple of (float, float)
        Times (s) of each update's effect and of the change of the reference at which its window began.
    channel_samples, channel_bytes : tuple of int
        Samples and bytes of the motor's and the position's channel together, for each window.
    message_bytes : tuple of int
        Bytes of each whole window message as sent.
    quantisation : float
        Largest half step of the decoded position, m.
    updates : tuple of messages.Update
        Updates sent by the twin.
    changes : tuple of SettingChange
        Settings in force at the edge, in order.
    """

    trace: Trace
    estimates: tuple[EstimateRecord, ...]
    applied: tuple[tuple[float, float], ...]
    channel_samples: tuple[int, ...]
    channel_bytes: tuple[int, ...]
    message_bytes: tuple[int, ...]
    quantisation: float
    updates: tuple[messages.Update, ...] = ()
    changes: tuple[SettingChange, ...] = ()


@dataclass(frozen=True, slots=True)
class TwinJob:
    """A packaged scenario with another servo, reference, seed, dead-zone gain or estimator.

    The scenarios and their estimator, with its settings, are the paper's. `OURS` is the default estimator with its
    defaults, and theta_m sent with 32 bits instead of 16. `exact` replaces the estimates by the true gap.
    """

    preset: str
    scenario: str = CONTINUOUS
    square: Square = BIPOLAR
    seed: int = SEEDS[0]
    k_dz: float = 1.0
    exact: bool = False
    method: str = PUBLISHED

    def scenario_to_run(self) -> st.Scenario:
        """Vary the packaged scenario."""
        packaged = st.Scenario.preset(self.scenario).with_servo(st.Servo.preset(self.preset))
        published = self.method == packaged.twin.method
        settings = packaged.twin.estimator if published else None
        return packaged.replace(
            reference=self.square.signal,
            recording=replace(packaged.recording, fine_angle=not published),
            seed=self.seed,
            twin=packaged.twin.replace(k_dz=self.k_dz, method=self.method, estimator=settings),
        )

    def run(self) -> TwinRun:
        """Co-simulate; reduce the run to the needs of figures and claims."""
        return run_twin(self.scenario_to_run(), exact=self.exact)


@dataclass(frozen=True, slots=True)
class TwinFamilyJob:
    """The steps of Fig 15's continuous run for a family of squares."""

    preset: str
    square: Square = BIPOLAR
    exact: bool = False

    def run(self) -> tuple[tuple[MeasuredStep, ...], ...]:
        """Co-simulate; one row of steps per member."""
        jobs = (TwinJob(self.preset, CONTINUOUS, member, exact=self.exact) for member in self.square.family)
        return tuple(job.run().trace.steps for job in jobs)


def run_twin(scenario: st.Scenario, exact: bool = False, progress: Progress | None = None) -> TwinRun:
    """Co-simulate a scenario, timing each estimate."""
    seconds: list[float] = []
    loop = st.cosimulate(scenario, progress, _timed(scenario, seconds, exact))
    return TwinRun(
        trace=Trace.of(loop.run),
        estimates=estimate_records(loop, seconds),
        applied=_applied(loop),
        channel_samples=tuple(sum(c.samples for c in _channels(w)) for w in loop.windows),
        channel_bytes=tuple(sum(len(c.data) for c in _channels(w)) for w in loop.windows),
        message_bytes=_window_bytes(loop),
        quantisation=max((_half_step(window) for window in loop.windows), default=0.0),
        updates=loop.updates,
        changes=_setting_changes(loop),
    )


def _timed(scenario: st.Scenario, seconds: list[float], exact: bool) -> Estimator:
    """Wrap the twin's own estimator, or one that knows the gap, to record the wall time of each call."""
    known = known_gap(scenario.gap, scenario.duration)
    chosen = known if exact else estimator_of(scenario.servo, scenario.twin)

    def estimate(window: Window, expected: Expectation) -> st.GapEstimate:
        begin = time.perf_counter()
        estimate = chosen(window, expected)
        seconds.append(time.perf_counter() - begin)
        return estimate

    return estimate


def estimate_records(loop: Loop, seconds: Sequence[float] | None = None) -> tuple[EstimateRecord, ...]:
    """Estimates of a co-simulation beside the true gap; `seconds` that each took, where they were measured."""
    seconds = [math.nan] * len(loop.estimates) if seconds is None else seconds
    times = [one.time for one in loop.estimates]
    truths = as_pieces(loop.scenario.gap, loop.scenario.duration).value(times)
    return tuple(
        EstimateRecord(
            time=one.time,
            gap=one.gap,
            std=one.std_total,
            interval=one.interval,
            status=one.status.value,
            reasons=one.reasons,
            truth=float(truth),
            seconds=spent,
        )
        for one, truth, spent in zip(loop.estimates, truths, seconds, strict=True)
    )


def _applied(loop: Loop) -> tuple[tuple[float, float], ...]:
    rate = loop.scenario.recording.sample_rate
    begins = {update.version: update.data_time for update in loop.updates}
    return tuple((receipt.sample / rate, begins[receipt.version]) for receipt in loop.applied)


def _channels(window: messages.WindowMessage) -> tuple[messages.Channel, ...]:
    """The two channels that the paper sends."""
    return tuple(c for c in window.channels if c.name in ("theta_m", "position"))


def _half_step(window: messages.WindowMessage) -> float:
    """Largest rounding error of the position as sent, m."""
    return max(c.scale / 2.0 for c in window.channels if c.name == "position")


def _window_bytes(loop: Loop) -> tuple[int, ...]:
    """Bytes of each window message, its first copy."""
    up = (m for m in loop.messages if m.direction == "up" and m.copy == 0)
    return tuple(len(m.data) for m in up if isinstance(m.message, messages.WindowMessage))


def _setting_changes(loop: Loop) -> tuple[SettingChange, ...]:
    """List every setting that was in force, in order; an update without gains leaves those in force before it."""
    start = loop.scenario.start
    changes = [
        SettingChange(
            0.0, SettingOrigin.START, start.setting.tolerance, gains_of(filtered_pid(loop.scenario.start_law))
        )
    ]
    for begin, origin, tolerance, gains in sorted(_later_settings(loop), key=lambda change: change[0]):
        changes.append(SettingChange(begin, origin, tolerance, gains or changes[-1].gains))
    return tuple(changes)


def _later_settings(loop: Loop) -> Iterator[tuple[float, SettingOrigin, float, messages.Gains | None]]:
    rate = loop.scenario.recording.sample_rate
    sent = {update.version: update for update in loop.updates}
    for receipt in loop.applied:
        update = sent[receipt.version]
        yield receipt.sample / rate, SettingOrigin.UPDATE, update.setting.tolerance, update.setting.pid
    for fallback in loop.fallbacks:
        yield fallback.sample / rate, SettingOrigin.FALLBACK, fallback.setting.tolerance, fallback.setting.pid


_WINDOW_GAPS_DEG, _WINDOW_STEPS = (3.0, 10.0, 18.0), 6


@dataclass(frozen=True, slots=True)
class WindowJob:
    """The published estimator's mean error (deg) by gap on noise-free 1 s windows after each of six steps.

    The estimator leaves out the first `settle` seconds of a window.
    """

    preset: str
    settle: float

    def run(self) -> Mapping[float, float]:
        """Mean error for each gap."""
        servo = st.Servo.preset(self.preset)
        return {gap: float(np.mean(_window_errors(servo, gap, self.settle))) for gap in _WINDOW_GAPS_DEG}


def _window_errors(servo: st.Servo, gap_deg: float, settle: float) -> list[float]:
    """Error of each window's estimate, deg; every search starts from two thirds of the truth."""
    gap = math.radians(gap_deg)
    run = st.simulate(
        servo,
        _WINDOW_STEPS * PERIOD / 2.0,
        reference=BIPOLAR.signal,
        gap=gap,
        tolerance=servo.tolerance_for(gap),
        sample_rate=RATE,
    )
    starts = np.arange(_WINDOW_STEPS) * PERIOD / 2.0
    windows = [st.Window.from_run(run, float(start), 1.0) for start in starts]
    settings = paper.PaperSettings(settle_s=settle)
    estimates = [
        st.estimate_gap(window, servo, method="paper", prior=gap * 2.0 / 3.0, settings=settings) for window in windows
    ]
    return [math.degrees(one.gap - gap) for one in estimates if one.ok]
