"""The workloads by name, each with its contestants and checks, in full or small size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from benchmarks import decisions, fits, hold, ours, solver, startup, taylor
from benchmarks.alone import ALONE
from benchmarks.contest import Check, Contestant, Workload
from benchmarks.report import cores
from benchmarks.workloads import UNIT, NoisyWorkload, SweepWorkload, WearWorkload
from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.redesign.certified.demands import Demands

MILLIMETRE = "/ 1 mm"


@dataclass(frozen=True)
class Options:
    """Small workloads (`quick`), contestants of many seconds (`slow`), and reference positions of W1."""

    quick: bool = False
    slow: bool = False
    reference: Path | None = None

    @property
    def wear(self) -> WearWorkload:
        """The wearing servo: in full 200 s with 10 reference steps; small 8 s with 4."""
        return WearWorkload(duration=8.0, period=4.0) if self.quick else WearWorkload()

    @property
    def sweep(self) -> SweepWorkload:
        """The ensemble: in full 16 x 16 runs of 20 s; small 3 x 3 of 1 s."""
        return SweepWorkload(side=3, duration=1.0) if self.quick else SweepWorkload()


Build: TypeAlias = Callable[[Options], Workload]


def w1(options: Options) -> Workload:
    """W1: one long run."""
    wear = options.wear
    slow = (solver.wearing(wear),) if options.slow else ()
    return Workload(
        "W1",
        f"one run of {wear.duration:g} s, gap 0 to 60 deg, 5 kHz",
        (ours.wearing(wear), *_holds(wear), taylor.wearing(wear), *slow),
        (Check("error", MILLIMETRE, lambda q: _largest(q - ours.refined_wear(wear))), *_against_file(options)),
        lambda seconds: f"{wear.duration / seconds:,.0f} x real time",
    )


def _holds(wear: WearWorkload) -> tuple[Contestant, ...]:
    return hold.wearing(wear, wear.sample_rate), hold.wearing(wear, 4.0 * wear.sample_rate)


def _against_file(options: Options) -> tuple[Check, ...]:
    """The check against positions at a divisor of the sample rate, under the key q3 of an npz file."""
    if options.reference is None:
        return ()
    if options.quick:
        raise InvalidInput("--reference belongs to the full W1; leave out --quick")
    wear, expected = options.wear, read_reference(options.reference)
    every, rest = divmod(wear.samples - 1, expected.size - 1)
    if rest or every == 0:
        raise InvalidInput(
            f"reference {options.reference}: q3 has {expected.size} samples, which do not lie on W1's {wear.samples}"
        )
    return (Check("to reference", MILLIMETRE, lambda q: _largest(q[::every] - expected)),)


def read_reference(path: Path) -> Array:
    """Positions (n,) in m.

    Raises
    ------
    InvalidInput
        The file cannot be read or has no one-dimensional q3 of at least two samples.
    """
    try:
        with np.load(path) as file:
            expected = np.asarray(file["q3"], dtype=float)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise InvalidInput(f"reference {path}: is not an npz file with positions q3 in m") from None
    if expected.ndim != 1 or expected.size < 2:
        raise InvalidInput(f"reference {path}: q3 has shape {expected.shape}; it must be (n,) with n of at least 2")
    return expected


def two_masses(options: Options) -> Workload:
    """One long run of a shaft with a gap, alone: no other solver here has its automaton."""
    duration = options.wear.duration
    return Workload(
        "two-mass",
        f"two-mass drive that knocks, {duration:g} s, gap 0 to 0.02 rad, 5 kHz",
        (ours.two_masses(duration),),
        (Check("error", "/ 1 mrad", lambda q: _largest(q - ours.refined_two_masses(duration))),),
        lambda seconds: f"{duration / seconds:,.0f} x real time",
    )


def w2(options: Options) -> Workload:
    """W2: an ensemble of short runs."""
    sweep, threads = options.sweep, cores()
    runs = sweep.side**2

    def error(q: Array) -> float:
        return _largest((q - ours.refined_sweep(sweep))[ours.comparable(sweep)])

    return Workload(
        "W2",
        f"{sweep.side} x {sweep.side} runs of {sweep.duration:g} s, gaps x tolerances, 100 Hz",
        (*_sweepers(sweep, threads), *(_sweepers(sweep, 1)[:1] if threads > 1 else ())),
        (Check("error", MILLIMETRE, error),),
        lambda seconds: f"{seconds / runs * 1e3:.3g} ms a run",
    )


def _sweepers(sweep: SweepWorkload, threads: int) -> tuple[Contestant, ...]:
    return (
        ours.sweeping(sweep, threads),
        hold.sweeping(sweep, 5e3, threads),
        hold.sweeping(sweep, 20e3, threads),
        taylor.sweeping(sweep, 1, 1),
        taylor.sweeping(sweep, taylor.BATCH, threads),
    )


def w3(options: Options) -> Workload:
    """W3: the gap from windows."""
    wear = options.wear
    return Workload(
        "W3",
        f"the gap from {wear.turns} windows of 1 s at 5 kHz",
        (
            fits.ours(wear),
            fits.scipy_fits(wear, "scipy BFGS, numba loop", fits.with_loop),
            fits.scipy_fits(wear, "scipy BFGS, scipy.signal", fits.with_lfilter),
            fits.ours(wear, "whitened"),
        ),
        (
            Check("error", "deg", lambda gaps: fits.typical_error(wear, gaps)),
            Check("wrong", "> 1 deg", lambda gaps: fits.wrong_answers(wear, gaps)),
        ),
        lambda seconds: f"{seconds / wear.turns * 1e3:.3g} ms a window",
    )


def sampled(options: Options) -> Workload:
    """The deployed loop, in noise."""
    return _noisy("sampled", "noise, loop filter", NoisyWorkload(options.wear))


def counts(options: Options) -> Workload:
    """The same with a sensor that counts."""
    return _noisy("counts", "noise, counts of 1 um", NoisyWorkload(options.wear, resolution=1e-6))


def calm(options: Options) -> Workload:
    """A loop that comes to rest in its gap, and an encoder's noise."""
    wear = replace(options.wear, preset="paper", calm=True)
    noisy = NoisyWorkload(wear, noise_std=1e-6, white=True, loop_filter_hz=None)
    return _noisy("calm", "noise, no integral action", noisy)


def _noisy(name: str, what: str, workload: NoisyWorkload) -> Workload:
    return Workload(
        name,
        f"{workload.wear.duration:g} s, law sampled at 5 kHz, {what}",
        (ours.noisy(workload), ours.ticked(workload), hold.noisy(workload)),
        (Check("error", MILLIMETRE, lambda q: _largest(q - ours.refined_noisy(workload))),),
        lambda seconds: f"{workload.wear.duration / seconds:,.0f} x real time",
    )


def quiet(options: Options) -> Workload:
    """The deployed loop without noise, as settings are verified."""
    return _noisy("quiet", "loop filter, no noise", NoisyWorkload(options.wear, noise_std=None))


def decision(options: Options) -> Workload:
    """Time of a decision of the certified policy."""
    machines = 16 if options.quick else Demands().machines
    return Workload(
        "decision",
        f"settings verified on {machines} machines",
        decisions.decisions(options.quick),
        (Check("not settled", "%", lambda result: 100.0 * (1.0 - float(result[0]))),),
        lambda _: "",
    )


def start(options: Options) -> Workload:
    """The first run of a fresh process."""
    return Workload(
        "start", "a fresh process to the end of its first run of 1 s", startup.starters(options.slow), (), lambda _: ""
    )


WORKLOADS: dict[str, Build] = {
    "W1": w1,
    "two-mass": two_masses,
    "W2": w2,
    "W3": w3,
    "sampled": sampled,
    "counts": counts,
    "calm": calm,
    "quiet": quiet,
    "decision": decision,
    "start": start,
}
_WITH = {"sampled": ("sampled", "counts", "calm", "quiet")}


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """Names of workloads in their usual order, whatever their case; none means all, and sampled brings counts,
    calm and quiet along.

    Raises
    ------
    InvalidInput
        A name that is none.
    """
    known = {name.lower(): name for name in WORKLOADS}
    for name in names:
        if name.lower() not in known:
            hint = did_you_mean(name, (*WORKLOADS, *ALONE))
            known_ones = f"{', '.join(WORKLOADS)}, or {' or '.join(ALONE)} alone"
            raise InvalidInput(f"workload {name!r} does not exist{hint}; give some of {known_ones}")
    selected = {known[name.lower()] for name in names} or set(WORKLOADS)
    selected = {other for name in selected for other in _WITH.get(name, (name,))}
    return tuple(name for name in WORKLOADS if name in selected)


def _largest(difference: Array) -> float:
    return float(np.max(np.abs(difference))) / UNIT if difference.size else 0.0
