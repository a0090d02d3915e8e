"""Windows of axis presets with free shafts whose channels are not what they should be, and the estimates from them.

``python -m benchmarks.axis_faults SEED MACHINES [KIND ...]`` prints a line for each kind of fault and preset. Machines
are drawn as in `benchmarks.preset_machines`, with gaps of one to ten healthy ones that stay; each gives four windows.
"""

from __future__ import annotations

import math
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.preset_machines import DUTIES, WORN, PresetMachine, preset_machines
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.load import LINEAR
from servotwin.plant.signals import Array
from servotwin.simulation import Run, Simulation

PRESETS = ("ball-screw", "robot-joint", "telescope", "gantry")
WINDOWS, _FINER = 4, 4  # of a machine; samples of the simulation between two of a window

Random = np.random.Generator
Fault = Callable[[Random, Array, float], Array]
"""Channel (n,) with a fault; the last argument is the gap in the channel's unit."""


def _held(random: Random, values: Array, gap: float) -> Array:
    """Three times the last sample is repeated 5 to 40 times while the channel moves by a tenth of the gap at least."""
    held = values.copy()
    for _ in range(3):
        size = int(random.integers(5, 41))
        moved = np.abs(values[size:] - values[:-size])
        first = int(random.choice(np.flatnonzero(moved > min(0.1 * gap, 0.5 * float(moved.max())))))
        held[first : first + size] = values[first]
    return held


def _stuck(random: Random, values: Array, _gap: float) -> Array:
    """One value from a moment in the middle half of the motion on."""
    share = np.cumsum(np.abs(np.diff(values)))
    first = int(np.searchsorted(share, random.uniform(0.25, 0.75) * share[-1]))
    return np.where(np.arange(values.size) < first, values, values[first])


def _spiked(largest: float) -> Fault:
    def spiked(random: Random, values: Array, gap: float) -> Array:
        out = values.copy()
        sizes = math.exp(random.uniform(math.log(0.3), math.log(largest))) * random.choice([-1.0, 1.0], 3)
        out[random.choice(np.arange(20, values.size - 20), 3, replace=False)] += gap * sizes
        return out

    return spiked


def _scaled(factor: float) -> Fault:
    return lambda _random, values, _gap: factor * values


@dataclass(frozen=True)
class ChannelFault:
    """What is wrong with position or angle, and jitter of the times of position or of both, in samples (rms).

    Shown: the position is in mm or degrees.
    """

    position: Fault | None = None
    angle: Fault | None = None
    shown: bool = False
    jitter: float = 0.0
    common: float = 0.0


KINDS: Mapping[str, ChannelFault] = {
    "none": ChannelFault(),
    "position held": ChannelFault(position=_held),
    "angle held": ChannelFault(angle=_held),
    "position stuck": ChannelFault(position=_stuck),
    "angle stuck": ChannelFault(angle=_stuck),
    "position spiked": ChannelFault(position=_spiked(10.0)),
    "angle spiked": ChannelFault(angle=_spiked(10.0)),
    "position doubled": ChannelFault(position=_scaled(2.0)),
    "position halved": ChannelFault(position=_scaled(0.5)),
    "position in mm or degrees": ChannelFault(shown=True),
    "angle in degrees": ChannelFault(angle=_scaled(math.degrees(1.0))),
    "angle reversed": ChannelFault(angle=_scaled(-1.0)),
    "position jitters by 0.1": ChannelFault(jitter=0.1),
    "position jitters by 0.3": ChannelFault(jitter=0.3),
    "position jitters by 1": ChannelFault(jitter=1.0),
    "both jitter by 0.3": ChannelFault(common=0.3),
}


@dataclass
class FaultTally:
    """Estimates of one kind and preset; *near*: off by at most 1 % of the gap or two counts."""

    windows: int = 0
    accepted: int = 0
    near: int = 0
    false: int = 0
    bounds_above: int = 0
    worst: float = 0.0
    widths: list[float] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, machine: PresetMachine, gap: float, estimate: GapEstimate) -> None:
        """Count one estimate; false: accepted, not near, and outside of its interval."""
        self.windows += 1
        self.bounds_above += estimate.status is GapStatus.LOWER_BOUND and estimate.gap > gap
        self.reasons.update(reason[:70] for reason in estimate.reasons[:1])
        if not estimate.ok:
            return
        error = abs(estimate.gap - gap)
        near, (low, high) = error <= max(0.01 * gap, 2.0 * machine.count), estimate.interval
        self.accepted += 1
        self.near += near
        self.false += not near and not low <= gap <= high
        self.worst = max(self.worst, error / gap)
        self.widths.append((high - estimate.gap) / gap)

    def __str__(self) -> str:
        """One line."""
        wide = f", half width {100.0 * float(np.median(self.widths)):.2g} %" if self.widths else ""
        reasons = "; ".join(f"{count} x {reason}" for reason, count in self.reasons.most_common(3))
        return (
            f"accepted {self.accepted} of {self.windows}, near {self.near}, false {self.false}, "
            f"worst {100.0 * self.worst:.2g} %{wide}, bounds above {self.bounds_above}; {reasons}"
        )


def faulty_windows(name: str, kind: str, machines: int, seed: int) -> Iterator[tuple[PresetMachine, float, Window]]:
    """Yield machines with their gap (rad at the motor) and a window of each of their steps."""
    for place, drawn in enumerate(preset_machines(name, machines, seed)):
        random = np.random.default_rng([seed, place, zlib.crc32(name.encode())])
        worn = math.exp(random.uniform(0.0, math.log(WORN)))
        machine = replace(drawn, worn=(worn, worn), steps=WINDOWS + 1)
        run, gap = _finer_run(machine), worn * DUTIES[name].gap / machine.model.p
        for step in range(1, WINDOWS + 1):
            faulty = np.random.default_rng([seed, place, step, zlib.crc32(kind.encode())])
            yield machine, gap, _window(machine, run, gap, step, KINDS[kind], faulty)


def _finer_run(machine: PresetMachine) -> Run:
    rate = _FINER * machine.rate
    simulation = Simulation(
        machine.plant, machine.duration, reference=machine.reference, gap=machine.gap, sample_rate=rate
    )
    simulation.advance(simulation.samples - 1)
    return simulation.run()


def _window(machine: PresetMachine, run: Run, gap: float, step: int, fault: ChannelFault, random: Random) -> Window:
    """The window of a step as a recorder with the fault would send it."""
    duty, rate, sensors = DUTIES[machine.name], machine.rate, machine.model.sensors
    first = round((step - duty.before) * duty.half_period * rate)
    time = (first + np.arange(round(duty.window * duty.half_period * rate))) / rate
    late = fault.common / rate * random.normal(size=time.size) if fault.common else np.zeros(time.size)
    later = fault.jitter / rate * random.normal(size=time.size) if fault.jitter else late
    angle = CubicSpline(run.time, run.theta_m)(time + late)
    position = CubicSpline(run.time, run.position)(time + later)
    if fault.angle is not None:
        angle = fault.angle(random, angle, gap)
    if fault.position is not None:
        position = fault.position(random, position, gap * machine.model.p)
    unit = (1e3 if machine.model.load.motion == LINEAR else math.degrees(1.0)) if fault.shown else 1.0
    return Window(
        unit * _rounded(position, sensors.position_resolution),
        _rounded(angle, sensors.encoder_resolution),
        sample_rate=rate,
        start=first / rate,
    )


def _rounded(values: Array, count: float) -> Array:
    return np.asarray(count * np.round(values / count)) if count > 0.0 else values


def tally(name: str, kind: str, machines: int, seed: int) -> FaultTally:
    """Estimate the windows of a preset with a kind of fault."""
    made = FaultTally()
    for machine, gap, window in faulty_windows(name, kind, machines, seed):
        made.add(machine, gap, estimate_gap(window, machine.model))
    return made


def main(seed: int, machines: int, *kinds: str) -> None:
    """Print a line for each kind, or for those given, and preset."""
    for kind in kinds or KINDS:
        for name in PRESETS:
            print(f"{kind}, {name}: {tally(name, kind, machines, seed)}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
