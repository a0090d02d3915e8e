"""Fig 10(b): the signals of the dead-zone controller and its switching."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import ESTIMATE_DEG, Runs, StepJob

SPAN = 4.0  # s


@dataclass(frozen=True, eq=False)
class Data:
    """Time (s), error e and dead-zone error e_DZ (m), voltage (V), tolerance (m); when the zone is entered and left."""

    time: Array
    error: Array
    dead_zone_error: Array
    voltage: Array
    tolerance: float
    enter: Array
    leave: Array


def data(runs: Runs) -> Data:
    """A 1 mm step with a gap of 10 deg and the dead zone for it, at the full rate."""
    job = StepJob(runs.preset, ESTIMATE_DEG, ESTIMATE_DEG, duration=SPAN)
    return runs.get(SignalsJob(job))


@dataclass(frozen=True, slots=True)
class SignalsJob:
    """The dead zone's signals in a step run."""

    step: StepJob

    def run(self) -> Data:
        """Signals at `RATE` and the exact times of the switches."""
        run = self.step.simulate()
        error, tolerance = run.reference - run.position, float(run.tolerance[0])
        inside = np.abs(error) <= tolerance
        enter, leave = (run.events.time[run.events.kind == kind] for kind in ("enter", "leave"))
        return Data(run.time, error, np.where(inside, 0.0, error), run.voltage, tolerance, enter, leave)


def plot(d: Data) -> Figure:
    """Error and dead-zone error above, voltage below; the dead zone shaded where it is active."""
    figure, axes = style.panels(2, 1, height=1.9)
    upper, lower = axes[:, 0]
    tolerance, fed = d.tolerance * style.MM, d.dead_zone_error * style.MM
    upper.axhspan(-tolerance, tolerance, color=style.YELLOW, alpha=0.5, linewidth=0.0, label="tolerance $±ε_{DZ}$")
    upper.plot(d.time, d.error * style.MM, color=style.BLUE, label="error $e$")
    upper.plot(d.time, fed, color=style.RED, linewidth=1.0, linestyle="--", label="dead-zone error $e_{DZ}$")
    upper.set_ylabel("Error (mm)")
    style.legend(upper)
    lower.plot(d.time, d.voltage, color=style.BLACK, linewidth=1.0, label="voltage $u$")
    lower.set(ylabel="Voltage (V)", xlabel="Time (s)", xlim=(0.0, SPAN))
    for begin, end in open_intervals(d):
        lower.axvspan(begin, end, color=style.YELLOW, alpha=0.5, linewidth=0.0)
    style.legend(lower)
    return figure


def open_intervals(d: Data) -> list[tuple[float, float]]:
    """When the loop was open: from each entry to the next exit, or to the end."""
    ends = [float(next(iter(d.leave[d.leave > begin]), d.time[-1])) for begin in d.enter]
    return list(zip(map(float, d.enter), ends, strict=True))


PLATE = Plate(
    "fig10b",
    "Fig 10(b). The dead-zone controller at work.",
    "A 1 mm step with a gap of 10 deg and the dead zone for it: above, the error and what the controller is fed;"
    " below, the voltage, zero while the error is inside the tolerance (shaded).",
    data,
    plot,
)
