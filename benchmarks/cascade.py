"""`python -m benchmarks.cascade`: the twin in the loop of a ball screw's cascade while its gap grows to ten times.

Each seed is a machine of its own: stiffness, damping and mass within the stated ranges, steps and input bias drawn. The
cascade alone runs on the same machine beside it.
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import numpy as np

import servotwin as st
from servotwin.commissioning.edge_settings import Recording
from servotwin.cosim.driver import Cosimulation
from servotwin.cosim.machine import SimulatedMachine, simulation_of
from servotwin.estimation.learning.trend_settings import TrendSettings
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.twin.settings import TwinSettings

SCREW = st.Axis.preset("ball-screw")
CASCADE = st.Cascade(
    100.0, SCREW.p, velocity_gain=0.012, integral_time=0.02, speed_filter=1e-3, voltage_limit=3.8, sample_rate=2000.0
)
HEALTHY, WORN = 5e-6 / SCREW.p, 50e-6 / SCREW.p
KNOWN = Uncertainty(gap=(0.0, 80e-6 / SCREW.p), step=(2e-4, 2e-3), input_bias=(-0.01, 0.01), k=0.05, c=0.2)
PERIOD = 4.0
"""s of the square wave; a window follows each of its steps."""
_NEAR = 0.02


class CascadeRow(NamedTuple):
    """Result of one machine: counts of windows and steps."""

    seed: int
    windows: int
    accepted: int
    outside: int
    applied: int
    refused: int
    fallbacks: int
    steps: int
    settled: int
    settled_alone: int


def scenario(seed: int, duration: float, machines: int) -> st.Scenario:
    """The twin's side of one seed: the preset's model with the cascade, and what is stated of it."""
    generator = np.random.default_rng(seed)
    twin = TwinSettings(
        policy="certified",
        uncertainty=KNOWN,
        demands=Demands(machines=machines, settled=0.99 if machines >= 300 else 0.9),
        initial_gap=HEALTHY,
        trend=TrendSettings.for_wear(WORN - HEALTHY, duration),
    )
    return st.Scenario(
        servo=SCREW.replace(controller=CASCADE),
        duration=duration,
        reference=st.SquareWave(float(generator.uniform(2e-4, 8e-4)), PERIOD),
        gap=st.SCurve(HEALTHY, WORN, duration=duration, begin=0.0),
        recording=Recording(sample_rate=2000.0),
        twin=twin,
        input_bias=float(generator.uniform(-0.008, 0.008)),
        seed=seed,
    )


def machine_of(seed: int) -> st.Axis:
    """The true machine of one seed."""
    generator = np.random.default_rng([seed, 1])
    names = {"k": 0.05, "c": 0.2}
    factors = {name: float(generator.uniform(1.0 - width, 1.0 + width)) for name, width in names.items()}
    return SCREW.replace(controller=CASCADE).scaled(factors)


def row_of(seed: int, duration: float, machines: int) -> CascadeRow:
    """Run one machine with its twin, and under the cascade alone."""
    here, true = scenario(seed, duration, machines), machine_of(seed)
    loop_of = Cosimulation(here, machine := SimulatedMachine(here, simulation_of(here, true)))
    while not loop_of.done:
        loop_of.advance()
    loop = loop_of.loop(machine.run())
    alone = st.simulate(
        true, duration, reference=here.reference, gap=here.gap, sample_rate=2000.0, input_bias=here.input_bias
    )
    truths = np.interp([each.time for each in loop.estimates], loop.run.time, loop.run.gap).tolist()
    good = [(each, truth) for each, truth in zip(loop.estimates, truths, strict=True) if each.ok]
    return CascadeRow(
        seed,
        len(loop.windows),
        len(good),
        sum(not each.interval[0] <= truth <= each.interval[1] for each, truth in good),
        len(loop.applied),
        sum(not receipt.applied for receipt in loop.receipts),
        len(loop.fallbacks),
        *settled_steps(loop.run),
        settled_steps(alone)[1],
    )


def settled_steps(run: st.Run) -> tuple[int, int]:
    """Steps, and those after which the last quarter until the next one is within 2 % of the step."""
    error, half = np.abs(run.reference - run.position), round(0.5 * PERIOD * run.sample_rate)
    size = float(np.ptp(run.reference))
    parts = [error[k : k + half] for k in range(0, len(error) - half, half)]
    return len(parts), sum(float(part[-half // 4 : -1].max()) <= _NEAR * size for part in parts)


def main() -> None:
    """Print a row for each seed, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=4, help="machines, one seed each")
    parser.add_argument("--seed", type=int, default=1, help="first seed")
    parser.add_argument("--duration", type=float, default=40.0, help="s in which the gap grows")
    parser.add_argument("--verified-on", type=int, default=300, help="simulated machines of each verification")
    options = parser.parse_args()
    print(*CascadeRow._fields)
    rows = []
    for seed in range(options.seed, options.seed + options.machines):
        rows.append(row_of(seed, options.duration, options.verified_on))
        print(*rows[-1], flush=True)
    print("all", *np.sum([row[1:] for row in rows], axis=0).tolist())
    share = sum(row.settled for row in rows) / max(1, sum(row.steps for row in rows))
    print(
        f"settled {100.0 * share:.1f} % of the steps; gap {math.degrees(HEALTHY):.3f} to {math.degrees(WORN):.3f} deg"
    )


if __name__ == "__main__":
    main()
