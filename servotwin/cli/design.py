"""Commands that design settings and analyse them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotwin.cli.own_options import ARCMIN, MDEG, UM, travels

_Enter = Annotated[float | None, typer.Option(help="Error at which the loop opens, in tolerances.")]
_Leave = Annotated[float | None, typer.Option(help="Error above which the loop closes again, in tolerances.")]
_Json = Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")]
_Duration = Annotated[
    float | None,
    typer.Option(help="Length of every run, s; by default 120 units of the servo's time scale.", show_default=False),
]
_Window = Annotated[
    float | None,
    typer.Option(
        help="Last part of a run, in which it must rest, s; by default 40 units of the servo's time scale.",
        show_default=False,
    ),
]
_Stillness = Annotated[
    float | None,
    typer.Option(
        help="A run rests if half its peak-to-peak is below this, um; by default 1 for the preset paper with a gap of "
        "10 deg, in proportion to pitch and gap.",
        show_default=False,
    ),
]
_Servo = Annotated[str, typer.Argument(help="A preset's name, or the TOML of a servo or an axis.")]


def limit_cycle(
    servo: _Servo = "paper",
    gap_deg: Annotated[
        float | None, typer.Option(help="Total gap at the motor, deg; 10 by default.", show_default=False)
    ] = None,
    gap_at_load_um: Annotated[float | None, UM] = None,
    gap_at_load_mdeg: Annotated[float | None, MDEG] = None,
    gap_at_load_arcmin: Annotated[float | None, ARCMIN] = None,
    tolerance_mm: Annotated[
        float | None, typer.Option(help="Half-width of the dead zone, mm; none by default.")
    ] = None,
    tolerance_deg: Annotated[float | None, typer.Option(help="The same for a rotary axis, deg.")] = None,
    step_mm: Annotated[
        float | None, typer.Option(help="Reference step from rest, mm; the result may depend on it; 1 by default.")
    ] = None,
    step_deg: Annotated[float | None, typer.Option(help="The same for a rotary axis, deg; 1 by default.")] = None,
    enter: _Enter = None,
    leave: _Leave = None,
    json: _Json = False,
) -> None:
    """Compute the exact limit cycle and its stability, and compare it with the describing function's prediction."""
    from servotwin.cli.limit_cycle import print_limit_cycle

    positions = {"mm": (tolerance_mm, step_mm), "deg": (tolerance_deg, step_deg)}
    at_load = travels("gap", gap_at_load_um, gap_at_load_mdeg, gap_at_load_arcmin)
    print_limit_cycle(servo, gap_deg, at_load, positions, enter, leave, json)


def tune(
    crossover: Annotated[float, typer.Argument(help="Gain crossover, rad/s.")],
    phase_margin_deg: Annotated[float, typer.Argument(help="Phase margin at the crossover, deg.")],
    servo: Annotated[str, typer.Option(help="A preset's name, or the TOML of a servo or an axis.")] = "paper",
    kind: Annotated[
        str,
        typer.Option("--type", help="P, PI, PD, PDF, PID or PIDF; cascade: of an axis, with an encoder at the motor."),
    ] = "PIDF",
    ms_max: Annotated[float, typer.Option(help="Largest sensitivity peak that is accepted.")] = float("inf"),
    prefer: Annotated[
        str, typer.Option(help="Ms: smallest Ms, then largest Ki; Ki: largest Ki within --ms-max.")
    ] = "Ms",
    delay_ms: Annotated[
        float, typer.Option(help="Delay in series with the plant, beside that of its encoder, ms.")
    ] = 0.0,
    b: Annotated[float, typer.Option(help="Setpoint weight of the proportional term.")] = 1.0,
    c: Annotated[float | None, typer.Option(help="Setpoint weight of the derivative term; by default b.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="TOML to be written: the servo or axis with these gains.")
    ] = None,
    json: _Json = False,
) -> None:
    """Find gains for a crossover and a phase margin, and compare them with the present controller, if there is one."""
    from servotwin.cli.tune import TuneOptions, print_tuning

    options = TuneOptions(
        servo=servo,
        kind=kind,
        crossover=crossover,
        phase_margin_deg=phase_margin_deg,
        Ms_max=ms_max,
        prefer=prefer,
        delay_ms=delay_ms,
        b=b,
        c=c,
        output=output,
    )
    print_tuning(options, json)


def map_(
    servo: _Servo = "paper",
    out: Annotated[Path, typer.Option(help="Folder of the map; the same command continues an interrupted one.")] = Path(
        "servotwin-map"
    ),
    tolerance: Annotated[
        str | None, typer.Option(help="Dead zone / (p b), with half gap b: LOW:HIGH:COUNT[:log] or VALUE,VALUE,...")
    ] = None,
    amplitude: Annotated[str | None, typer.Option(help="Reference step / (p b), in the same form.")] = None,
    gap_deg: Annotated[
        str | None, typer.Option(help="Instead of --tolerance and --amplitude: total gap at the motor, deg.")
    ] = None,
    gap_at_load_um: Annotated[str | None, UM] = None,
    gap_at_load_mdeg: Annotated[str | None, MDEG] = None,
    gap_at_load_arcmin: Annotated[str | None, ARCMIN] = None,
    estimate_deg: Annotated[
        str | None, typer.Option(help="With a gap: estimate of it at the motor, deg; by default the true gap.")
    ] = None,
    estimate_at_load_um: Annotated[str | None, UM] = None,
    estimate_at_load_mdeg: Annotated[str | None, MDEG] = None,
    estimate_at_load_arcmin: Annotated[str | None, ARCMIN] = None,
    k_dz: Annotated[str | None, typer.Option(help="With a gap: dead zone / (p estimate).")] = None,
    amplitude_mm: Annotated[str | None, typer.Option(help="With a gap: reference step, mm.")] = None,
    amplitude_deg: Annotated[str | None, typer.Option(help="The same for a rotary axis, deg.")] = None,
    enter: _Enter = None,
    leave: _Leave = None,
    members: Annotated[int, typer.Option(help="Initial states in each cell.")] = 16,
    motion: Annotated[
        float, typer.Option(help="Size of the initial motion; every second state is in motion, 0: none.")
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of the initial states.")] = 0,
    duration: _Duration = None,
    window: _Window = None,
    still_um: _Stillness = None,
    still_mdeg: Annotated[
        float | None, typer.Option(help="The same for a rotary axis, thousandths of a degree.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler whose workers do the work: tcp://host:8786.")
    ] = None,
) -> None:
    """Compute a stability map: for which dead zones and steps the loop settles, from many initial states."""
    from servotwin.cli.map.command import stability_map
    from servotwin.cli.map.options import MapOptions

    options = MapOptions(
        servo,
        tolerance=tolerance,
        amplitude=amplitude,
        gap_deg=gap_deg,
        estimate_deg=estimate_deg,
        at_load={
            **travels("gap", gap_at_load_um, gap_at_load_mdeg, gap_at_load_arcmin),
            **travels("estimate", estimate_at_load_um, estimate_at_load_mdeg, estimate_at_load_arcmin),
        },
        k_dz=k_dz,
        amplitude_mm=amplitude_mm,
        amplitude_deg=amplitude_deg,
        enter=enter,
        leave=leave,
        members=members,
        motion=motion,
        seed=seed,
        duration=duration,
        window=window,
        still_um=still_um,
        still_mdeg=still_mdeg,
    )
    stability_map(options, out, workers, scheduler)


def certify(
    file: Annotated[Path, typer.Argument(help="A twin's file, or a scenario's TOML.")],
    model: Annotated[str | None, typer.Option(help="One of its models; by default all that name a table.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="File of the table; by default the one that the key `table` names.")
    ] = None,
    finest_deg: Annotated[
        float | None,
        typer.Option(
            help="Width of the narrowest cells in the gap, deg at the motor; by default a sixteenth of the stated "
            "range.",
            show_default=False,
        ),
    ] = None,
    finest_at_load_um: Annotated[float | None, UM] = None,
    finest_at_load_mdeg: Annotated[float | None, MDEG] = None,
    finest_at_load_arcmin: Annotated[float | None, ARCMIN] = None,
    bias_mv: Annotated[
        str | None,
        typer.Option(
            help="Largest input bias that the feedforward leaves, mV: VALUE,VALUE,...; by default 1,10,50 in the "
            "servo's own volts, or less: the largest is at most half of the stated bias.",
            show_default=False,
        ),
    ] = None,
    bias_mn_m: Annotated[str | None, typer.Option(help="The same of an axis that commands a torque, mN m.")] = None,
    bias_mrad_per_s: Annotated[str | None, typer.Option(help="The same of one that commands a speed, mrad/s.")] = None,
    bias_mrad: Annotated[str | None, typer.Option(help="The same of a stepper, mrad.")] = None,
    noise_um: Annotated[
        str | None,
        typer.Option(
            help="Rms noise for which settings are ranked, um: VALUE,...; by default none, and a tenth of the smallest "
            "stated step.",
            show_default=False,
        ),
    ] = None,
    noise_mdeg: Annotated[str | None, typer.Option(help="The same of a rotary axis, thousandths of a degree.")] = None,
) -> None:
    """Verify a table of settings, for twins that look them up. The same command continues an interrupted run."""
    from servotwin.cli.certify import GridOptions
    from servotwin.cli.certify import certify as run

    biases = {"bias_mv": bias_mv, "bias_mn_m": bias_mn_m, "bias_mrad_per_s": bias_mrad_per_s, "bias_mrad": bias_mrad}
    finest = travels("finest", finest_at_load_um, finest_at_load_mdeg, finest_at_load_arcmin)
    run(file, model, out, GridOptions(finest_deg, biases, {"noise_um": noise_um, "noise_mdeg": noise_mdeg}, finest))
