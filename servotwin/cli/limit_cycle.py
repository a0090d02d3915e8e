"""`servotwin limit-cycle`: the exact orbit, its multipliers and the describing function's prediction."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from servotwin.analysis.limit_cycles.cycle import CycleResult, limit_cycle
from servotwin.analysis.limit_cycles.describing import limit_cycle_near, predictions
from servotwin.analysis.limit_cycles.orbit import Orbit
from servotwin.analysis.limit_cycles.shaft import Prediction
from servotwin.cli.gap_options import stated_gap
from servotwin.cli.own_options import own_option
from servotwin.errors import InvalidInput
from servotwin.plant.display_units import MILLIMETRES, DisplayUnit, gap_in_words, position_unit
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant, resolve_plant
from servotwin.plant.signals import turn_in_words

_GAP_DEG = 10.0  # where none is given

# Orbits whose frequencies differ by a smaller share are the same orbit.
_EVENTS = 12  # shown of an orbit
_SAME = 1e-6


@dataclass(frozen=True)
class Findings:
    """Findings of the command.

    Attributes
    ----------
    result : CycleResult
        Where the loop ends after the step.
    predictions : tuple of (Prediction, CycleResult)
        Each prediction, and the exact orbit that it leads to.
    no_prediction : str
        Reason why the describing function predicts nothing; empty where it does.
    """

    result: CycleResult
    predictions: tuple[tuple[Prediction, CycleResult], ...]
    no_prediction: str


def findings(servo: Plant, gap: float, tolerance: float | None, step: float) -> Findings:
    """Compute the limit cycles and predictions of a servo with a gap (rad), a tolerance (m) and after a step (m)."""
    result = limit_cycle(servo, gap, tolerance, step=step)
    if tolerance:
        return Findings(result, (), "a dead zone is a second nonlinearity, which the describing function leaves out")
    if gap == 0.0:
        return Findings(result, (), "there is no gap")
    try:
        predicted = predictions(servo, gap)
    except InvalidInput as error:
        return Findings(result, (), str(error))
    none = "" if predicted else "it predicts no limit cycle"
    return Findings(result, tuple((one, limit_cycle_near(servo, gap, one)) for one in predicted), none)


def print_limit_cycle(
    name: str,
    gap_deg: float | None,
    at_load: Mapping[str, float],
    positions: Mapping[str, tuple[float | None, float | None]],
    enter: float | None,
    leave: float | None,
    as_json: bool,
) -> None:
    """Print a table, or one JSON object, on the standard output.

    The gap is stated in degrees at the motor or, by key, `at_load`; `positions` are tolerance and step by their unit.
    """
    servo = resolve_plant(name)
    unit = position_unit(servo)
    tolerance_shown, step_shown = _in_unit(name, servo, positions)
    # The exact orbit is that of the continuous-time loop.
    servo = servo.replace(sample_rate=None)
    servo = servo if enter is None else servo.replace(enter=enter)
    servo = servo if leave is None else servo.replace(leave=leave)
    tolerance = None if tolerance_shown is None else unit.si_of(tolerance_shown)
    gap = _gap(name, servo, gap_deg, at_load)
    computed = findings(servo, gap, tolerance, unit.si_of(step_shown))
    if as_json:
        print(json.dumps(as_dict(computed, unit), indent=2))
        return
    console = Console()
    console.print(
        f"{name}: total gap {gap_in_words(servo, gap)}, {_dead_zone(tolerance_shown, unit)}, after a "
        f"step of {step_shown:g} {unit.name}",
        highlight=False,
    )
    _print(console, computed, unit)


def as_dict(computed: Findings, unit: DisplayUnit = MILLIMETRES) -> dict[str, Any]:
    """Make the JSON object: plain numbers, with units in the keys; `unit` is that of positions."""
    return {
        "status": computed.result.status.value,
        "reason": computed.result.reason,
        "settling_s": computed.result.settling,
        "orbit": _orbit(computed.result.orbit, unit),
        "describing_function": [
            {
                "frequency_hz": one.frequency,
                "motor_amplitude_deg": math.degrees(one.motor_amplitude),
                f"amplitude_{unit.name}": one.amplitude * unit.factor,
                "stable": one.stable,
                "orbit": _orbit(near.orbit, unit),
                "reason": near.reason,
            }
            for one, near in computed.predictions
        ],
        "no_prediction": computed.no_prediction,
    }


def _orbit(orbit: Orbit | None, unit: DisplayUnit) -> dict[str, Any] | None:
    if orbit is None:
        return None
    half = orbit.half_multipliers
    return {
        "frequency_hz": orbit.frequency,
        f"amplitude_{unit.name}": orbit.amplitude * unit.factor,
        f"lowest_{unit.name}": orbit.lowest * unit.factor,
        f"highest_{unit.name}": orbit.highest * unit.factor,
        "motor_amplitude_deg": math.degrees(orbit.motor_amplitude),
        "stable": orbit.stable,
        "symmetric": orbit.symmetric,
        "multipliers": [[value.real, value.imag] for value in orbit.multipliers.tolist()],
        "half_multipliers": None if half is None else [[value.real, value.imag] for value in half.tolist()],
        "events": [{"phase": event.phase, "kind": event.kind, "side": event.side} for event in orbit.events],
        "residual": orbit.residual,
    }


def _gap(name: str, servo: Plant, gap_deg: float | None, at_load: Mapping[str, float]) -> float:
    """The gap at the motor, rad; refused beyond a turn."""
    form, given = stated_gap("gap", gap_deg, at_load, name, servo)
    size, most = _GAP_DEG if given is None else given, form.shown(servo.largest_gap)
    if not 0.0 <= size <= most * (1.0 + 1e-12):
        turn = turn_in_words(servo.largest_gap)
        raise InvalidInput(f"{form.option} {size:g} {form.unit}: must be from 0 to {most:g}, {turn}")
    return form.at_motor(size)


def _in_unit(
    name: str, servo: Plant, positions: Mapping[str, tuple[float | None, float | None]]
) -> tuple[float | None, float]:
    """Tolerance and step, in the unit of a machine; refused in another."""
    unit, units = position_unit(servo), own_units(servo)
    tolerance, step = (
        own_option({f"{option}_{each}": given[place] for each, given in positions.items()}, f"{option}_mm", name, units)
        for place, option in enumerate(("tolerance", "step"))
    )
    if step is not None and not (math.isfinite(step) and step != 0.0):
        raise InvalidInput(
            f"--step-{unit.name} {step:g} {unit.name}: must be finite and not 0, or the loop never leaves its rest"
        )
    if tolerance is not None and not (math.isfinite(tolerance) and tolerance >= 0.0):
        raise InvalidInput(f"--tolerance-{unit.name} {tolerance:g} {unit.name}: must be finite and 0 or more")
    return tolerance, 1.0 if step is None else step


def _dead_zone(tolerance: float | None, unit: DisplayUnit) -> str:
    return f"dead zone of {tolerance:g} {unit.name} either way" if tolerance else "no dead zone"


def _print(console: Console, computed: Findings, unit: DisplayUnit) -> None:
    result = computed.result
    orbit = result.orbit
    console.print(f"[bold]{result.status.value}[/]{': ' if result.reason else ''}{result.reason}")
    heads = "frequency\nHz", f"amplitude of\nposition, {unit.name}", "amplitude of\nmotor, deg"
    table = Table("", *heads, "", box=None, pad_edge=False)
    if orbit is not None:
        table.add_row("exact, after the step", *_cells(orbit, unit))
    for one, near in computed.predictions:
        table.add_row(
            "describing function",
            f"{one.frequency:.4f}",
            f"{one.amplitude * unit.factor:.4f}",
            f"{math.degrees(one.motor_amplitude):.2f}",
            _stability(one.stable),
        )
        if near.orbit is not None and (orbit is None or abs(near.orbit.frequency / orbit.frequency - 1.0) > _SAME):
            table.add_row("exact, near that", *_cells(near.orbit, unit))
    if table.rows:
        console.print(table, highlight=False)
    if orbit is not None:
        _print_orbit(console, orbit)
    if computed.no_prediction:
        console.print(
            f"no prediction by the describing function: {computed.no_prediction}", style="dim", highlight=False
        )


def _cells(orbit: Orbit, unit: DisplayUnit) -> tuple[str, ...]:
    angle = math.degrees(orbit.motor_amplitude)
    return f"{orbit.frequency:.9f}", f"{orbit.amplitude * unit.factor:.9f}", f"{angle:.4f}", _stability(orbit.stable)


def _stability(stable: bool) -> str:
    return "stable" if stable else "unstable"


def _print_orbit(console: Console, orbit: Orbit) -> None:
    if orbit.half_multipliers is not None:
        console.print(f"Floquet multipliers of half a period: {_sizes(orbit.half_multipliers)}", highlight=False)
    console.print(f"Floquet multipliers of the period: {_sizes(orbit.multipliers)}", highlight=False)
    shown = [f"{event.kind} {event.side:+d} at {event.phase:.4f}" for event in orbit.events[:_EVENTS]]
    more = len(orbit.events) - len(shown)
    events = ", ".join([*shown, f"and {more} more (--json lists all)"] if more else shown)
    console.print(f"events, as shares of the period: {events}", highlight=False)
    check = f"check: one period of the event simulation closes the orbit to {orbit.residual:.1e} of its range"
    console.print(check, style="dim", highlight=False)


def _sizes(values: Any) -> str:
    return ", ".join(f"{size:.4f}" for size in map(abs, values.tolist()) if size >= 5e-5)
