"""Commands that simulate, estimate and measure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotwin.cli.own_options import ARCMIN, MDEG, UM, travels
from servotwin.errors import InvalidInput

# Columns of a foreign log, as all commands take them.
MotorColumn = Annotated[str | None, typer.Option("--motor", help="Column of the motor's position.")]
LoadColumn = Annotated[str | None, typer.Option("--load", help="Column of the load's position, by its own encoder.")]
CommandColumn = Annotated[str | None, typer.Option("--command", help="Column of the motor's command.")]
TimeColumn = Annotated[str | None, typer.Option("--time", help="Column of the time.")]
SampleRate = Annotated[
    float | None,
    typer.Option("--rate", help="Sample rate, Hz; replaces the log's own times."),
]
TimeUnit = Annotated[
    str | None, typer.Option("--time-unit", help="Unit of the time, such as ms, if the header does not state it.")
]
MotorUnit = Annotated[
    str | None,
    typer.Option("--motor-unit", help="Unit of --motor, such as deg or rev/4096, if the header does not state it."),
]
LoadUnit = Annotated[
    str | None, typer.Option("--load-unit", help="Unit of --load, such as mm, if the header does not state it.")
]
LeadMm = Annotated[float | None, typer.Option("--lead-mm", help="Travel of a linear load per turn of the motor, mm.")]
Ratio = Annotated[float | None, typer.Option("--ratio", help="Turns of the motor per turn of a rotary load.")]
_LOGS = "Recordings: .csv, .txt, .npz, .parquet, .mat, .h5, .mf4, .tdms, .mcap ..."


def demo(
    scenario: Annotated[
        Path | None,
        typer.Argument(
            help="Scenario of another machine, of any axis; the paper's servo where absent.", show_default=False
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the report.")] = Path("servotwin-demo"),
    preset: Annotated[str, typer.Option(help="Of the paper's servo: paper, table1 or paper-gain2.")] = "paper",
) -> None:
    """Simulate a machine that wears out: alone, with the paper's dead zone and with its twin."""
    from servotwin.cli.demo import demo as run

    run(out, preset, scenario=scenario)


def reproduce(
    only: Annotated[
        list[str] | None, typer.Option(help="Only these figures and claims, such as fig12 or crossover.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the figures, claims.json and report.html.")] = Path(
        "reproduction"
    ),
    preset: Annotated[str, typer.Option(help="Preset of the figures; claims are measured in all three.")] = "paper",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
) -> None:
    """Reproduce every figure and claim of the paper, and compare them with our measurements."""
    from servotwin.reproduction.reproduce import reproduce as run

    run(out, only=tuple(only or ()), preset=preset, workers=workers)


def simulate(
    scenario: Annotated[
        Path, typer.Argument(help="A scenario's TOML, or fig15, fig15-sampled, fig16, calm or certified.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File for the signals: run.parquet, run.npz or run.csv.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Picture of signals, gap and estimates: .png or .svg.", show_default=False)
    ] = None,
    windows: Annotated[
        bool, typer.Option("--windows", help="A line for each window: gap, estimate, status, what followed.")
    ] = False,
) -> None:
    """Run one scenario; say what its twin found, and write the signals."""
    from servotwin.cli.simulate import record

    record(scenario, output, figure=figure, windows=windows)


def convert(
    log: Annotated[Path, typer.Argument(help="A log with time_s, position_m, theta_m_rad ..., or any with --motor.")],
    output: Annotated[Path, typer.Argument(help="run.csv, which an edge can replay, run.npz or run.parquet.")],
    motor: MotorColumn = None,
    load: LoadColumn = None,
    command: CommandColumn = None,
    time: TimeColumn = None,
    rate: SampleRate = None,
    motor_unit: MotorUnit = None,
    load_unit: LoadUnit = None,
    time_unit: TimeUnit = None,
) -> None:
    """Convert a recorded log to another format. Damaged samples of foreign logs are repaired or left out."""
    from servotwin.cli.simulate import convert as run
    from servotwin.cli.simulate import convert_recording
    from servotwin.logs.log import holds_signals
    from servotwin.logs.recordings import RecordingColumns

    columns = RecordingColumns(motor, load, command, time, rate, motor_unit, load_unit, time_unit)
    if columns == RecordingColumns() and holds_signals(log):
        run(log, output)
        return
    for defect, count in convert_recording(log, output, columns).items():
        print(f"{defect}: {count}")


def identify(
    logs: Annotated[list[Path], typer.Argument(help=_LOGS)],
    motor: MotorColumn = None,
    load: LoadColumn = None,
    command: CommandColumn = None,
    time: TimeColumn = None,
    rate: SampleRate = None,
    motor_unit: MotorUnit = None,
    load_unit: LoadUnit = None,
    time_unit: TimeUnit = None,
    lead_mm: LeadMm = None,
    ratio: Ratio = None,
    page: Annotated[Path | None, typer.Option(help="Page or picture of the gap: .html, .png or .svg.")] = None,
    servo: Annotated[
        str | None, typer.Option(help="Model of the machine: a preset or a servo's TOML; by default the log's own.")
    ] = None,
    axis: Annotated[
        str | None,
        typer.Option(help="An axis's file or preset: its wind-up by friction is subtracted from the lost motion."),
    ] = None,
    stiff: Annotated[
        bool,
        typer.Option("--stiff", help="Instead of --axis: nothing winds up, so that the lost motion is the gap."),
    ] = False,
    dynamics: Annotated[
        bool,
        typer.Option("--dynamics", help="Fit the load's dynamics together with the gap, even if it does not swing."),
    ] = False,
    dates: Annotated[
        str | None, typer.Option(help="Dates of the logs, such as 2026-03-01,2026-06-01; by default their time stamps.")
    ] = None,
    start: Annotated[
        float | None, typer.Option(help="Start of a single window, s, instead of a window at each step.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of that window, s; by default to the end of the log.")
    ] = None,
    window: Annotated[
        float | None,
        typer.Option(
            help="Length of the windows at the steps, s; by default the log's, or 1 (free shaft: 8) of the machine."
        ),
    ] = None,
    pre_trigger: Annotated[float | None, typer.Option(help="Length of the part before the step, s.")] = None,
    method: Annotated[str, typer.Option(help="whitened or paper.")] = "whitened",
    wear_deg: Annotated[
        float | None, typer.Option(help="Typical growth of the gap, deg, in the time of --wear-over-s.")
    ] = None,
    wear_at_load_um: Annotated[float | None, UM] = None,
    wear_at_load_mdeg: Annotated[float | None, MDEG] = None,
    wear_at_load_arcmin: Annotated[float | None, ARCMIN] = None,
    wear_over_s: Annotated[
        float | None,
        typer.Option(
            help="Time of that growth, s; by default 0.2 deg/s of the paper's servo in the machine's own second, of an "
            "axis what its log shows."
        ),
    ] = None,
    gap_limit_deg: Annotated[float | None, typer.Option(help="Predict when the gap reaches this limit, deg.")] = None,
    gap_limit_at_load_um: Annotated[float | None, UM] = None,
    gap_limit_at_load_mdeg: Annotated[float | None, MDEG] = None,
    gap_limit_at_load_arcmin: Annotated[float | None, ARCMIN] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
) -> None:
    """Estimate the gap from recordings of two encoders, or with a model of the machine (--servo, or the log's own)."""
    from servotwin.cli.identify import IdentifyOptions
    from servotwin.cli.identify_report import show
    from servotwin.cli.lost_motion import show as show_lost_motion
    from servotwin.estimation.kinematic.travel import stated_travel
    from servotwin.logs.log import describes_its_machine
    from servotwin.logs.recordings import RecordingColumns

    columns = RecordingColumns(motor, load, command, time, rate, motor_unit, load_unit, time_unit)
    options = IdentifyOptions(
        log=logs[0],
        servo=servo,
        start=start,
        duration=duration,
        window=window,
        pre_trigger=pre_trigger,
        method=method,
        wear_deg=wear_deg,
        wear_over_s=wear_over_s,
        gap_limit_deg=gap_limit_deg,
        at_load={
            **travels("wear", wear_at_load_um, wear_at_load_mdeg, wear_at_load_arcmin),
            **travels("gap_limit", gap_limit_at_load_um, gap_limit_at_load_mdeg, gap_limit_at_load_arcmin),
        },
    )
    travel = stated_travel(lead_mm, ratio)
    stated = any(each is not None for each in (axis, dates, travel)) or stiff or dynamics
    without_model = columns != RecordingColumns() or stated
    if without_model or (servo is None and not describes_its_machine(logs[0])):
        if options != IdentifyOptions(log=logs[0]):
            raise InvalidInput(
                "servotwin identify: --servo, --start, --duration, --window, --pre-trigger, --method, --wear-... and "
                "--gap-limit-... need a model of the machine: give --servo, without --motor, --load and other columns"
            )
        show_lost_motion(logs, columns, json, page, axis, dates, stiff, dynamics, travel)
        return
    if len(logs) > 1 or page is not None:
        raise InvalidInput(
            "servotwin identify: with a model (--servo, or the log's own) one log at a time and no --page; give "
            "--motor and --load for the gap between two encoders alone"
        )
    show(options, json)


def commission(
    logs: Annotated[list[Path], typer.Argument(help=_LOGS + " of one drive")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="The axis file, axis.toml.")] = None,
    motor: MotorColumn = None,
    command: CommandColumn = None,
    reference: Annotated[str | None, typer.Option(help="Column of the position's reference.")] = None,
    load: LoadColumn = None,
    time: TimeColumn = None,
    rate: SampleRate = None,
    motor_unit: MotorUnit = None,
    reference_unit: Annotated[str | None, typer.Option(help="Unit of --reference if the position has another.")] = None,
    load_unit: LoadUnit = None,
    time_unit: TimeUnit = None,
    command_unit: Annotated[
        str | None, typer.Option(help="Unit of --command (N, 'N m', A or V) if the header does not state it.")
    ] = None,
    scale: Annotated[
        float | None, typer.Option(help="Force (rotary: torque) at the load per unit of the command, N or N m.")
    ] = None,
    inertia: Annotated[
        float | None, typer.Option(help="Instead of --scale: total moving mass, kg (rotary: inertia, kg m^2).")
    ] = None,
    lead_mm: LeadMm = None,
    ratio: Ratio = None,
    position_gain: Annotated[
        float | None, typer.Option(help="Position gain of the cascade that ran, 1/s; fitted by default.")
    ] = None,
    velocity_gain: Annotated[
        float | None, typer.Option(help="Its velocity gain: command per m/s or rad/s; fitted by default.")
    ] = None,
    integral_time: Annotated[
        float | None, typer.Option(help="Integral time of its velocity loop, s; fitted by default.")
    ] = None,
    speed_filter: Annotated[
        float | None, typer.Option(help="Time constant of its speed filter, s; fitted by default.")
    ] = None,
    kp: Annotated[
        float | None, typer.Option(help="Kp of the PID that ran: command per m or rad; fitted by default.")
    ] = None,
    ki: Annotated[float | None, typer.Option(help="Ki of that PID: command per m s or rad s.")] = None,
    kd: Annotated[float | None, typer.Option(help="Kd of that PID: command per m/s or rad/s.")] = None,
    derivative_filter: Annotated[float | None, typer.Option(help="Time constant of its derivative filter, s.")] = None,
    feedback: Annotated[
        str,
        typer.Option(help="Encoder of the new axis's position loop: motor, or load, which the twin needs."),
    ] = "motor",
    applied: Annotated[bool, typer.Option("--applied", help="The logged command is after the drive's limit.")] = False,
    crossover: Annotated[
        float | None,
        typer.Option(
            help="Tune the axis's cascade to this velocity-loop crossover, rad/s; by default it keeps the fitted gains."
        ),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Write a scenario whose twin has the uncertainty of the fit, scenario.toml.")
    ] = None,
    largest_gap: Annotated[
        float | None, typer.Option(help="Final gap at the load in that scenario, mm (rotary: deg).")
    ] = None,
    page: Annotated[Path | None, typer.Option(help="Page or picture of the fit: .html, .png or .svg.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
) -> None:
    """Identify inertia and friction from logs of command and position in closed loop, and write an axis file."""
    from servotwin.cli.commission import CommissionOptions, show
    from servotwin.estimation.inverse_dynamics.fitted_cascade import GivenGains
    from servotwin.estimation.inverse_dynamics.fitted_pid import GivenPid
    from servotwin.estimation.inverse_dynamics.identify import stated_law
    from servotwin.estimation.kinematic.travel import stated_travel
    from servotwin.logs.drive_recordings import DriveColumns

    travel = stated_travel(lead_mm, ratio)
    columns = DriveColumns(
        motor, command, reference, load, time, rate, motor_unit, command_unit, reference_unit, load_unit, scale,
        None if travel is None else travel.per_radian, time_unit,
    )  # fmt: skip
    show(
        CommissionOptions(
            logs=logs,
            columns=columns,
            gains=stated_law(
                GivenGains(position_gain, velocity_gain, integral_time, speed_filter),
                GivenPid(kp, ki, kd, derivative_filter),
            ),
            inertia=inertia,
            feedback=feedback,
            applied=applied,
            crossover=crossover,
            output=output,
            scenario=scenario,
            largest_gap=largest_gap,
            page=page,
            as_json=json,
        )
    )


def dataset(
    name: Annotated[str, typer.Argument(help="Name of a public set: emps, or bros-1 to bros-3.")],
    folder: Annotated[Path | None, typer.Option(help="Where to store it; by default the user's cache.")] = None,
) -> None:
    """Fetch a public set of measured data, once, and print the path of its file."""
    from servotwin.datasets import DATASETS, fetch

    if name in DATASETS:
        typer.echo(f"{name}: {DATASETS[name].source}; {DATASETS[name].notice}", err=True)
    print(fetch(name, folder))


def bench(context: typer.Context) -> None:
    """Compare speed and accuracy with other solvers (in a source checkout only)."""
    try:
        from benchmarks.cli import app
    except ModuleNotFoundError as error:
        if error.name != "benchmarks":
            raise
        raise InvalidInput(
            "servotwin bench: the benchmarks are part of the source checkout; run python -m benchmarks there"
        ) from None
    status = app(context.args, prog_name="servotwin bench", standalone_mode=False)
    if status == 130:  # Typer returns the status of an interrupt instead of raising it
        raise KeyboardInterrupt
