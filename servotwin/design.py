"""Design of controllers in Python: tune for a crossover, and map which dead zones settle."""

from __future__ import annotations

import math
from collections.abc import Sequence

from servotwin.analysis.maps.axes import Axes, PhysicalAxes, RatioAxes
from servotwin.analysis.maps.measures import compute_cells
from servotwin.analysis.maps.result import StabilityMap
from servotwin.analysis.maps.settings import MapSettings
from servotwin.analysis.tuning.tune import Specification, Tuning
from servotwin.analysis.tuning.tune import tune as tune_system
from servotwin.control.laws import AnyController, filtered_pid
from servotwin.errors import InvalidInput
from servotwin.plant.linear import LinearSystem, series
from servotwin.plant.loop import loop_filter, notch
from servotwin.plant.plants import Plant


def tune(
    servo: Plant,
    crossover: float,
    phase_margin: float,
    *,
    kind: str = "PIDF",
    Ms_max: float = math.inf,
    prefer: str = "Ms",
    delay: float = 0.0,
) -> Tuning:
    """Find a continuous controller with a given gain crossover and phase margin, for the servo without a gap.

    Parameters
    ----------
    servo : Servo or Axis
        Its own controller gives the loop filter, dead zone and limits of the result.
    crossover : float
        Gain crossover, rad/s.
    phase_margin : float
        Phase margin there, rad.
    kind : str
        P, PI, PD, PDF, PID or PIDF.
    Ms_max : float
        Largest sensitivity peak that is accepted.
    prefer : str
        "Ms": the smallest Ms, then the largest Ki; "Ki": the largest Ki within `Ms_max`.
    delay : float
        Delay in series with the plant, s, beside that of its encoder.

    Returns
    -------
    Tuning
        ``controller``, ``margins``, and the factors and candidates of the search.

    Raises
    ------
    InvalidInput
        A value is out of its range, or no such controller exists; the message says what can be reached.
    """
    if phase_margin > math.pi:
        raise InvalidInput(
            f"phase_margin = {phase_margin:g} rad: must be above 0 and below pi; did you mean"
            f" math.radians({phase_margin:g})?"
        )
    specification = Specification(crossover, phase_margin, kind, Ms_max, prefer)
    law = filtered_pid(servo.controller).replace(sample_rate=None)
    return tune_system(tuned_system(servo), specification, delay + servo.sensors.fed_back(servo.p).delay, law)


def tuned_system(servo: Plant) -> LinearSystem:
    """System that `tune` closes the loop around: the plant with the controller's loop filter and notch in series."""
    law = filtered_pid(servo.controller)
    return series(series(servo.plant(), loop_filter(law)), notch(law))


def stability_map(
    servo: Plant,
    *,
    controller: AnyController | None = None,
    tolerance: Sequence[float] | None = None,
    gap: Sequence[float] | None = None,
    k_dz: Sequence[float] = (1.0,),
    estimate: Sequence[float] = (),
    amplitude: Sequence[float] | None = None,
    members: int = 16,
    motion: float = 1.0,
    seed: int = 0,
    duration: float | None = None,
    window: float | None = None,
    still: float | None = None,
    threads: int | None = None,
) -> StabilityMap:
    """Simulate every cell of a grid from many initial states and measure which of them settle.

    Give either `tolerance` (a map in ratios, which serves every gap) or `gap`.

    Parameters
    ----------
    servo : Servo or Axis
    controller : Controller, Cascade or LinearLaw, optional
        Continuous; the servo's own by default.
    tolerance, gap : sequence of float, optional
        Dead-zone half-width / (p b), b half the gap; total gap, rad.
    k_dz, estimate : sequence of float
        With `gap`: dead zone / (p estimate), and the estimate of the total gap, rad; without an estimate the true gap.
    amplitude : sequence of float, optional
        Reference step: in p b with `tolerance` (35 by default), in m with `gap` (1 mm by default).
    members : int
        Initial states in each cell.
    motion, seed : float, int
        Extent of the motion that half of them start in; seed of the initial states.
    duration, window, still : float, optional
        Length of every run, s; end of it in which the position must rest, s; half the peak-to-peak below which it
        rests, m. By default those of `MapSettings`, in the servo's own units.
    threads : int, optional

    Returns
    -------
    StabilityMap
        ``grid("settled")`` is the share of the members that settle, shaped as the axes.

    Raises
    ------
    InvalidInput
        Both or neither of `tolerance` and `gap` are given, or a value is out of its range.
    """
    axes: Axes
    if tolerance is not None and gap is None:
        axes = RatioAxes(tuple(tolerance), tuple(amplitude or (35.0,)))
    elif gap is None or tolerance is not None:
        raise InvalidInput("stability map: give either tolerance (in p b) or gap (rad)")
    else:
        axes = PhysicalAxes(tuple(gap), tuple(k_dz), tuple(amplitude or (1e-3,)), tuple(estimate))
    settings = MapSettings(servo, axes, controller, members, motion, seed, duration, window, still)
    return StabilityMap(settings, compute_cells(settings, threads))
