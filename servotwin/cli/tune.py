"""`servotwin tune`: gains, all crossovers and Ms for a specification, beside the servo's present controller."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from servotwin.analysis.tuning.candidates import CONTROLLER_TYPES
from servotwin.analysis.tuning.cascade import tune_cascade, under_cascade
from servotwin.analysis.tuning.setpoint import overshoot
from servotwin.analysis.tuning.tune import Tuning, evaluate
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import LINEAR_LAW, AnyController, filtered_pid
from servotwin.control.linear_law import LinearLaw
from servotwin.design import tune, tuned_system
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.axis_file import file_values
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.loop import gain_units
from servotwin.plant.margins import Margins
from servotwin.plant.plants import Plant, resolve_plant
from servotwin.plant.release import release_time
from servotwin.runtime.files import atomic_output, check_file

# A loop with a delay has infinitely many phase crossovers; those beyond this gain margin are not shown.
_FAR = 1e3
CASCADE = "cascade"
"""Type of the law that is tuned, beside those of the filtered PID."""
_CASCADE_GAINS = ("position_gain", "velocity_gain", "integral_time")


@dataclass(frozen=True)
class TuneOptions:
    """The command's arguments, in its units."""

    servo: str
    kind: str
    crossover: float
    phase_margin_deg: float
    Ms_max: float
    prefer: str
    delay_ms: float
    b: float
    c: float | None
    output: Path | None = None


def print_tuning(request: TuneOptions, as_json: bool) -> None:
    """Print a table, or one JSON object, on the standard output; write the tuned axis or servo where that is asked."""
    if not 0.0 < request.phase_margin_deg < 180.0:
        raise InvalidInput(f"phase margin {request.phase_margin_deg:g} deg: must be above 0 and below 180 deg")
    if request.output is not None:
        check_file(request.output, (".toml",))
    if request.kind not in (types := (*CONTROLLER_TYPES, CASCADE)):
        raise InvalidInput(f"--type {request.kind}: must be one of {', '.join(types)}")
    servo = resolve_plant(request.servo, tuned=False)
    if request.kind == CASCADE:
        servo = _with_cascade(servo, request)
    if isinstance(servo, Axis) and isinstance(servo.controller, Cascade):
        print_cascade(servo, servo.controller, request, as_json)
        return
    if isinstance(servo.controller, LinearLaw):
        raise InvalidInput(
            f'{request.servo}: controller.kind = "{LINEAR_LAW}": tune finds the gains of a filtered PID or a cascade; '
            "describe one of these in the table [controller]"
        )
    own, sensor = filtered_pid(servo.controller), servo.sensors.fed_back(servo.p).delay
    delay = 1e-3 * request.delay_ms
    tuning = tune(
        servo,
        request.crossover,
        math.radians(request.phase_margin_deg),
        kind=request.kind,
        Ms_max=request.Ms_max,
        prefer=request.prefer,
        delay=delay,
    )
    overshoots = None
    b, c = request.b, request.b if request.c is None else request.c
    if delay + sensor == 0.0:
        weighted = overshoot(servo, tuning.controller, b, c)
        overshoots = (overshoot(servo, tuning.controller), weighted)
    _write(request, servo, tuning.controller.replace(sample_rate=own.sample_rate))
    if as_json:
        print(json.dumps(as_dict(tuning, overshoots), indent=2))
        return
    console = Console()
    laws = {"tuned": (tuning.controller, tuning.margins)}
    if any((own.Kp, own.Ki, own.Kd)):
        laws["present"] = own, evaluate(tuned_system(servo), own, delay + sensor)
    _print(console, servo, laws)
    angles = tuning.factors
    shown = ", ".join(f"{n} = {math.degrees(getattr(angles, n)):.3f} deg" for n in ("phz", "be", "al"))
    console.print(f"factors at {angles.wc:g} rad/s: K = {angles.K:.6g}, {shown}", highlight=False)
    console.print(f"{tuning.stable} of {tuning.candidates} candidates are stable", style="dim", highlight=False)
    if overshoots is not None:
        more = f"; with setpoint weights b = {b:g}, c = {c:g}: {100 * overshoots[1]:.1f} %"
        more = more if (b, c) != (1.0, 1.0) else ""
        console.print(f"overshoot without a gap {100 * overshoots[0]:.1f} %{more}", highlight=False)
    _print_written(console, request)


def _write(request: TuneOptions, servo: Plant, law: AnyController) -> None:
    """Write the axis or servo with its new controller, if that is asked, once this is stable at its sample rate."""
    if request.output is None:
        return
    servo.check_loop(law)
    if servo.controller.release_time == release_time(servo.margins):
        # Nobody stated it: it is that of the loop with the old gains.
        law = law.replace(release_time=None)
    changed = dataclasses.replace(servo, controller=law)  # type: ignore[arg-type]
    with atomic_output(request.output) as temporary:
        temporary.write_text(changed.dumps(), encoding="utf-8")


def _print_written(console: Console, request: TuneOptions) -> None:
    if request.output is not None:
        console.print(f"written: {request.output}", highlight=False)


def print_cascade(axis: Axis, own: Cascade, request: TuneOptions, as_json: bool) -> None:
    """Print a cascade tuned from inside outwards: crossover and margin are those of its velocity loop."""
    margin, delay = math.radians(request.phase_margin_deg), 1e-3 * request.delay_ms
    _check_cascade(request)
    tuned = tune_cascade(axis, request.crossover, margin, delay=delay)
    if tuned.margins.Ms > request.Ms_max:
        raise InvalidInput(
            f"--ms-max {request.Ms_max:g}: the cascade with this crossover and phase margin has Ms = "
            f"{tuned.margins.Ms:.4g}; lower the crossover, or raise the margin"
        )
    _write(request, axis, tuned.controller)
    found, present = (file_values(law, axis.actuator.unit, axis.load.motion) for law in (tuned.controller, own))
    gains = {name: value for name, value in found.items() if name.startswith(_CASCADE_GAINS)}
    if as_json:
        loop = {"omega": tuned.position_crossover, "phase_margin_deg": math.degrees(tuned.position_margin)}
        print(json.dumps({"gains": gains, "position_loop": loop, "Ms": tuned.margins.Ms}, indent=2))
        return
    heads = ("tuned", "present") if own.position_gain > 0.0 else ("tuned",)
    table = Table("", *heads, box=None, pad_edge=False)
    for name, value in gains.items():
        shown = (f"{value:.6g}", f"{present.get(name, math.nan):.6g}")
        table.add_row(name, *shown[: len(heads)])
    console = Console()
    console.print(table, highlight=False)
    if own.velocity_gain is not None:
        inner = f"{request.crossover:.4f} rad/s ({request.phase_margin_deg:.2f} deg)"
        console.print(f"velocity loop, crossover (phase margin): {inner}", highlight=False)
    outer = f"{tuned.position_crossover:.4f} rad/s ({math.degrees(tuned.position_margin):.2f} deg)"
    console.print(f"position loop, crossover (phase margin): {outer}", highlight=False)
    console.print(f"at the command, crossovers (phase margins): {_crossovers(tuned.margins)}", highlight=False)
    console.print(f"Ms at the command, at the law's own rate: {tuned.margins.Ms:.4f}", highlight=False)
    _print_written(console, request)


def _with_cascade(servo: Plant, request: TuneOptions) -> Axis:
    """The axis whose controller is a cascade, or becomes one."""
    if not isinstance(servo, Axis):
        raise InvalidInput(
            f"--type {CASCADE}: {request.servo} is a servo, whose controller is a filtered PID; a cascade is that of "
            "an axis"
        )
    return servo if isinstance(servo.controller, Cascade) else under_cascade(servo, request.crossover)


def _check_cascade(request: TuneOptions) -> None:
    """Refuse options that only a filtered PID has."""
    kind = "PIDF" if request.kind == CASCADE else request.kind
    plain = {"--type": (kind, "PIDF"), "--prefer": (request.prefer, "Ms"), "--b": (request.b, 1.0)}
    for option, (given, default) in {**plain, "--c": (request.c, None)}.items():
        if given != default:
            raise InvalidInput(f"{option} {given}: is for a filtered PID; leave it out for a cascade")


def as_dict(tuning: Tuning, overshoots: tuple[float, float] | None) -> dict[str, Any]:
    """Make the JSON object; null for a number that is infinite or unknown."""
    law, margins = tuning.controller, tuning.margins
    return {
        "Kp": law.Kp,
        "Ki": law.Ki,
        "Kd": law.Kd,
        "Tf": law.Tf,
        "K": tuning.factors.K,
        "angles_deg": {name: math.degrees(getattr(tuning.factors, name)) for name in ("phz", "be", "al")},
        "crossovers": [
            {"omega": x.omega, "phase_margin_deg": math.degrees(x.phase_margin)} for x in margins.gain_crossovers
        ],
        "gain_margins": [{"omega": x.omega, "gain_margin": x.gain_margin} for x in margins.phase_crossovers],
        "Ms": margins.Ms,
        "Ms_omega": margins.Ms_omega,
        "bandwidth": margins.bandwidth if math.isfinite(margins.bandwidth) else None,
        "candidates": tuning.candidates,
        "stable_candidates": tuning.stable,
        "overshoot": None if overshoots is None else overshoots[0],
        "overshoot_weighted": None if overshoots is None else overshoots[1],
    }


def _print(console: Console, servo: Plant, rows: dict[str, tuple[Controller, Margins]]) -> None:
    units = gain_units(command_unit(servo), position_unit(servo).si)
    heads = (f"{gain}\n{unit}" for gain, unit in zip(("Kp", "Ki", "Kd", "Tf"), units, strict=True))
    table = Table("", *heads, "Ms", box=None, pad_edge=False)
    for name, (law, margins) in rows.items():
        gains = (f"{value:.6g}" for value in (law.Kp, law.Ki, law.Kd, law.Tf))
        table.add_row(name, *gains, f"{margins.Ms:.4f}")
    console.print(table, highlight=False)
    for name, (_, margins) in rows.items():
        if not margins.stable:
            console.print(f"{name}: the loop is unstable", highlight=False)
            continue
        console.print(f"{name}, crossovers (phase margins): {_crossovers(margins)}", highlight=False)
        first = [
            f"{x.gain_margin:.3f} at {x.omega:.2f} rad/s" for x in margins.phase_crossovers if x.gain_margin < _FAR
        ]
        if first:
            console.print(f"{name}, gain margins: {', '.join(first)}", highlight=False)


def _crossovers(margins: Margins) -> str:
    return ", ".join(f"{x.omega:.4f} rad/s ({math.degrees(x.phase_margin):.2f} deg)" for x in margins.gain_crossovers)
