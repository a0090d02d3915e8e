"""Gaps from the motor's encoder and the command alone, on machines of presets that are drawn like the axis presets.

``python -m benchmarks.motor_windows SEED COUNT [PRESET,...]`` prints a line for each window, and one for each preset.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks.preset_machines import DUTIES, WORN, PresetMachine, preset_machines
from servotwin.estimation import motor_side
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.simulation import simulate

PRESETS = ("two-mass-drive", "robot-joint", "gantry")
_LEAST = 1.0
"""Smallest gap over the healthy one; the largest is that of the axis presets."""


def motor_window(machine: PresetMachine, worn: float) -> tuple[Window, float]:
    """A window without the load's position of a machine under its own controller, and its total gap, rad."""
    duty, rate = DUTIES[machine.name], machine.rate
    gap = worn * duty.gap / machine.model.p
    half = round(duty.half_period * rate) / rate
    run = simulate(machine.plant, 2.0 * half, reference=machine.reference, gap=gap, sample_rate=rate)
    begin, length = (round(share * half * rate) / rate for share in (1.0 - duty.before, duty.window))
    seen = Window.from_run(run, begin, length)
    return Window(theta_m=seen.theta_m, voltage=seen.voltage, sample_rate=rate, start=begin), gap


def judged(estimate: GapEstimate, gap: float, count: float) -> str:
    """Verdict on an estimate: near is within 1 % of the gap or two counts."""
    if not estimate.ok:
        return estimate.status.value
    near = abs(estimate.gap - gap) <= max(0.01 * gap, 2.0 * count)
    inside = estimate.interval[0] <= gap <= estimate.interval[1]
    return ("near" if near else "wide") if inside else ("near, outside" if near else "FALSE")


def main(seed: int, count: int, names: tuple[str, ...]) -> None:
    """Print windows and sums."""
    for name in names:
        random = np.random.default_rng([seed, 77, list(DUTIES).index(name)])
        verdicts, errors, begun = list[str](), list[float](), time.process_time()
        for machine in preset_machines(name, count, seed):
            window, gap = motor_window(machine, float(random.uniform(_LEAST, WORN)))
            estimate = estimate_gap(window, machine.model, motor_side.METHOD)
            verdicts.append(judged(estimate, gap, machine.model.encoder_resolution))
            off = estimate.gap / gap - 1.0
            errors += [abs(off)] if estimate.ok else []
            width = 0.5 * (estimate.interval[1] - estimate.interval[0]) / gap
            print(
                f"{name} {gap * machine.model.p / DUTIES[name].gap:.2f} x healthy: {verdicts[-1]} "
                f"off {100.0 * off:+.2f} %, half-width {100.0 * width:.2g} % {'; '.join(estimate.reasons)}",
                flush=True,
            )
        sums = ", ".join(f"{verdicts.count(each)} {each}" for each in sorted(set(verdicts)))
        middle = 100.0 * float(np.median(errors)) if errors else float("nan")
        spent = (time.process_time() - begun) / count
        print(f"{name}, seed {seed}: {sums}; median error {middle:.2g} %; {spent:.2g} s each", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), tuple(sys.argv[3].split(",")) if len(sys.argv) > 3 else PRESETS)
