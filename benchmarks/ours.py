"""servotwin as a contestant, and its finer runs as the reference of all answers."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.contest import Contestant
from benchmarks.workloads import NoisyWorkload, SweepWorkload, WearWorkload, knocking_drive
from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.axis import Axis
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import Run, Simulation, simulate
from servotwin.simulation.continuous import ContinuousEngine
from servotwin.simulation.ensemble import Cases, simulate_members

NAME = "servotwin"
REFINED = 4  # factor by which the reference runs search finer for events
PERTURBATION = 1e-12  # of the step
SENSITIVE = 1e-9  # of the step: members that the perturbation moves farther than this are not compared


def run_wear(workload: WearWorkload) -> Run:
    """W1's run."""
    return simulate(
        workload.servo,
        workload.duration,
        reference=workload.reference,
        gap=workload.gap,
        tolerance=workload.tolerance,
        sample_rate=workload.sample_rate,
    )


def run_noisy(workload: NoisyWorkload, sample_rate: float | None = None) -> Run:
    """The sampled run, recorded at its own rate or at a multiple of it."""
    wear = workload.wear
    return simulate(
        workload.servo,
        wear.duration,
        controller=workload.controller,
        reference=wear.reference,
        gap=wear.gap,
        tolerance=wear.tolerance,
        sample_rate=sample_rate or wear.sample_rate,
        noise=workload.noise,
        seed=workload.seed,
    )


def wearing(workload: WearWorkload) -> Contestant:
    """W1."""

    def remark() -> str:
        return f"{int(run_wear(workload).events.state_triggered.sum())} events"

    return Contestant(NAME, lambda: lambda: run_wear(workload).position, remark=remark)


def noisy(workload: NoisyWorkload) -> Contestant:
    """The sampled run."""
    return Contestant(NAME, lambda: lambda: run_noisy(workload).position)


def ticked(workload: NoisyWorkload) -> Contestant:
    """The sampled run, tick by tick as a run that is stopped and changed on its way."""
    return Contestant(f"{NAME}, tick by tick", lambda: lambda: _ticked(workload, workload.wear.sample_rate))


def _ticked(workload: NoisyWorkload, sample_rate: float) -> Array:
    wear = workload.wear
    simulation = Simulation(
        workload.servo,
        wear.duration,
        controller=workload.controller,
        reference=wear.reference,
        gap=wear.gap,
        tolerance=wear.tolerance,
        sample_rate=sample_rate,
        noise=workload.noise,
        seed=workload.seed,
    )
    simulation.advance(simulation.samples - 1)
    return simulation.run().position


def sweeping(workload: SweepWorkload, threads: int) -> Contestant:
    """W2."""
    gaps, tolerances = workload.members
    servo, duration = workload.servo, workload.duration

    def job() -> Array:
        cases = Cases(workload.step, gaps, tolerances)
        return simulate_members(servo, None, duration, cases, ("position",), workload.sample_rate, threads)["position"]

    return Contestant(f"{NAME}, {threads} thread{'s' * (threads > 1)}", lambda: job)


@cache
def _two_mass_drive() -> Axis:
    """The knocking drive in continuous time, read once as the presets."""
    return knocking_drive().replace(sample_rate=None)


def _two_masses(duration: float) -> Simulation:
    """The two-mass drive, its gap growing to ten times the healthy one."""
    return Simulation(
        _two_mass_drive(),
        duration,
        reference=SquareWave(0.2, 0.2 * duration),
        gap=SCurve(0.0, 0.02, duration),
        sample_rate=5000.0,
    )


def two_masses(duration: float) -> Contestant:
    """Two inertias on a shaft with a gap."""

    def run() -> Run:
        simulation = _two_masses(duration)
        simulation.advance(simulation.samples - 1)
        return simulation.run()

    def remark() -> str:
        return f"{int(run().events.state_triggered.sum())} events"

    return Contestant(NAME, lambda: lambda: run().position, remark=remark)


@cache
def refined_two_masses(duration: float) -> Array:
    """Its positions (N,) rad from a search for events in steps `REFINED` times shorter."""
    return _refined(_two_masses(duration))


@cache
def refined_wear(workload: WearWorkload) -> Array:
    """W1's positions (N,) m from a search for events in steps `REFINED` times shorter."""
    simulation = Simulation(
        workload.servo,
        workload.duration,
        reference=workload.reference,
        gap=workload.gap,
        tolerance=workload.tolerance,
        sample_rate=workload.sample_rate,
    )
    return _refined(simulation)


@cache
def refined_noisy(workload: NoisyWorkload) -> Array:
    """The sampled run's positions (N,) m with `REFINED` base steps a tick."""
    return _ticked(workload, REFINED * workload.wear.sample_rate)[::REFINED]


@cache
def refined_sweep(workload: SweepWorkload) -> Array:
    """W2's positions (K, N) m, each member run by itself and searched `REFINED` times finer."""
    servo, duration, rate = workload.servo, workload.duration, workload.sample_rate
    members = zip(*(values.tolist() for values in workload.members), strict=True)
    runs = [
        Simulation(servo, duration, reference=workload.step, gap=gap, tolerance=tolerance, sample_rate=rate)
        for gap, tolerance in members
    ]
    return np.array([_refined(run) for run in runs])


@cache
def comparable(workload: SweepWorkload) -> NDArray[np.bool_]:
    """(K,) members of W2 that a perturbation of the step leaves where they are."""
    gaps, tolerances = workload.members
    runs = [
        simulate_members(
            workload.servo, None, workload.duration, Cases(step, gaps, tolerances), ("position",), workload.sample_rate
        )["position"]
        for step in (workload.step, workload.step * (1.0 + PERTURBATION))
    ]
    moved = np.max(np.abs(runs[1] - runs[0]), axis=1)
    return np.asarray(moved <= SENSITIVE * workload.step)


def _refined(simulation: Simulation) -> Array:
    assert isinstance(simulation.controller, Controller)
    engine = ContinuousEngine(simulation.servo, simulation.controller, simulation.inputs, refine=REFINED)
    engine.advance(simulation.samples - 1)
    return engine.channel("position", 0, simulation.samples)
