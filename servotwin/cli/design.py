"""Commands that make settings, and look at what they do."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def limit_cycle(
    servo: Annotated[str, typer.Argument(help="A preset's name or a servo's TOML.")] = "paper",
    gap_deg: Annotated[float, typer.Option(help="Total gap, deg.")] = 10.0,
    tolerance_mm: Annotated[float | None, typer.Option(help="Half-width of the dead zone; none by default.")] = None,
    step_mm: Annotated[float, typer.Option(help="Reference step from rest; where the loop ends may hang on it.")] = 1.0,
    enter: Annotated[float | None, typer.Option(help="The loop opens at so many tolerances.")] = None,
    leave: Annotated[float | None, typer.Option(help="The loop closes again above so many tolerances.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
) -> None:
    """The exact limit cycle, stable or not, beside the describing function's prediction."""
    from servotwin.cli.limit_cycle import tell

    tell(servo, gap_deg, tolerance_mm, step_mm, enter, leave, json)


def tune(
    crossover: Annotated[float, typer.Argument(help="Wanted gain crossover, rad/s.")],
    phase_margin_deg: Annotated[float, typer.Argument(help="Wanted phase margin there, deg.")],
    servo: Annotated[str, typer.Option(help="A preset's name or a servo's TOML.")] = "paper",
    kind: Annotated[str, typer.Option("--type", help="P, PI, PD, PDF, PID or PIDF.")] = "PIDF",
    ms_max: Annotated[float, typer.Option(help="Largest sensitivity peak that is accepted.")] = float("inf"),
    prefer: Annotated[
        str, typer.Option(help="Ms: smallest Ms, then largest Ki; Ki: largest Ki within --ms-max.")
    ] = "Ms",
    delay_ms: Annotated[float, typer.Option(help="A delay in series with the plant.")] = 0.0,
    b: Annotated[float, typer.Option(help="Setpoint weight of the proportional term.")] = 1.0,
    c: Annotated[float | None, typer.Option(help="Setpoint weight of the derivative term; as b by default.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
) -> None:
    """Gains for a crossover and a phase margin, with every crossover and Ms beside the present controller's."""
    from servotwin.cli.tune import Request, tell

    tell(Request(servo, kind, crossover, phase_margin_deg, ms_max, prefer, delay_ms, b, c), json)


def map_(
    servo: Annotated[str, typer.Argument(help="A preset's name or a servo's TOML.")] = "paper",
    out: Annotated[Path, typer.Option(help="Where the map goes, and its finished pieces.")] = Path("servotwin-map"),
    tolerance: Annotated[
        str | None, typer.Option(help="Dead zone / (p b), b half the gap: LOW:HIGH:COUNT[:log] or VALUE,VALUE,...")
    ] = None,
    amplitude: Annotated[str | None, typer.Option(help="Reference step / (p b), likewise.")] = None,
    gap_deg: Annotated[str | None, typer.Option(help="Instead of these two: total gap, deg ...")] = None,
    estimate_deg: Annotated[str | None, typer.Option(help="... its estimate; the truth by default ...")] = None,
    k_dz: Annotated[str | None, typer.Option(help="... dead zone / (p estimate) ...")] = None,
    amplitude_mm: Annotated[str | None, typer.Option(help="... and reference step.")] = None,
    enter: Annotated[float | None, typer.Option(help="The loop opens at so many tolerances.")] = None,
    leave: Annotated[float | None, typer.Option(help="The loop closes again above so many tolerances.")] = None,
    members: Annotated[int, typer.Option(help="Initial states in each cell.")] = 16,
    motion: Annotated[float, typer.Option(help="Extent of the motion that half of them start in.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Of the initial states.")] = 0,
    duration: Annotated[float, typer.Option(help="Of every run, s.")] = 120.0,
    window: Annotated[float, typer.Option(help="The end of it in which a run must be still, s.")] = 40.0,
    still_um: Annotated[float, typer.Option(help="Still: half the peak-to-peak is below this.")] = 1.0,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="A Dask scheduler, tcp://host:8786, whose workers do the work.")
    ] = None,
) -> None:
    """A stability map: which dead zones settle which steps, from many initial states."""
    from servotwin.cli.map.command import stability_map
    from servotwin.cli.map.request import Request

    axes = (tolerance, amplitude, gap_deg, estimate_deg, k_dz, amplitude_mm)
    runs = (members, motion, seed, duration, window, still_um)
    stability_map(Request(servo, *axes, enter, leave, *runs), out, workers, scheduler)


def certify(
    file: Annotated[Path, typer.Argument(help="A twin's file, or a scenario's TOML.")],
    model: Annotated[str | None, typer.Option(help="One of its models; all that name a table without.")] = None,
    out: Annotated[Path | None, typer.Option(help="The table; the file that the key table names without.")] = None,
    finest_deg: Annotated[float, typer.Option(help="Width of the narrowest cells of gaps.")] = 4.0,
    bias_mv: Annotated[
        str, typer.Option(help="Largest input bias beside the feedforward: VALUE,VALUE,...")
    ] = "1,10,50",
    noise_um: Annotated[str, typer.Option(help="Noise for which settings are ranked, rms: VALUE,...")] = "0,10",
) -> None:
    """Prove settings beforehand, for twins that look them up; goes on where it was interrupted."""
    from servotwin.cli.certify import certify as run
    from servotwin.cli.certify import grid_of

    run(file, model, out, grid_of(finest_deg, bias_mv, noise_um))
