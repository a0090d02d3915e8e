"""The command line. Nothing heavy is imported until a command runs, so that help and errors come at once.

A new command is a function with ``@app.command()`` that imports what it needs in its body. User errors are raised as
`InvalidInput` anywhere below; `_Commands` turns them into one sentence and exit code 2, and an interrupt into 130.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from servotwin.errors import InvalidInput

INVALID, INTERRUPTED = 2, 130

# Before numpy is loaded: matrices are small here, and OpenBLAS's threads only wait for one another. On two busy cores
# some thousand exponentials of 4 x 4 matrices took 24 s of processor time with two threads and 0.03 s with one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


class _Commands(TyperGroup):
    """The group of all commands, with the one error handler."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except InvalidInput as error:
            _end(f"error: {error}", INVALID)
        except KeyboardInterrupt as interrupt:
            _end(str(interrupt) or "interrupted; nothing half written was left behind", INTERRUPTED)


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A digital twin that keeps a motion controller tuned while its machine wears.",
)


def _end(message: str, code: int) -> None:
    print(message, file=sys.stderr)
    raise typer.Exit(code) from None


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"servotwin {version('servotwin')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, typer.Option(callback=_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    """Options of every command."""


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Where the report goes.")] = Path("servotwin-demo"),
    preset: Annotated[str, typer.Option(help="paper, table1 or paper-gain2.")] = "paper",
) -> None:
    """A servo wears out twice: once alone, once watched over by its twin."""
    from servotwin.demo import demo as run

    run(out, preset)


@app.command()
def reproduce(
    only: Annotated[list[str] | None, typer.Option(help="Only these figures and claims: fig12, crossover ...")] = None,
    out: Annotated[Path, typer.Option(help="Where figures, claims.json and report.html go.")] = Path("reproduction"),
    preset: Annotated[str, typer.Option(help="The preset of the figures; claims are measured in all three.")] = "paper",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
) -> None:
    """Every figure and claim of the paper beside what we measure."""
    from servotwin.reproduce.everything import reproduce as run

    run(out, only=tuple(only or ()), preset=preset, workers=workers)


@app.command()
def simulate(
    scenario: Annotated[Path, typer.Argument(help="A scenario's TOML.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="run.parquet, run.npz or run.csv.")],
) -> None:
    """Run one scenario and write its signals."""
    from servotwin.record import record

    record(scenario, output)


@app.command()
def convert(
    log: Annotated[Path, typer.Argument(help="A .csv, .npz or .parquet with time_s, position_m, theta_m_rad ...")],
    output: Annotated[Path, typer.Argument(help="run.csv, which an edge can replay, run.npz or run.parquet.")],
) -> None:
    """A recorded log in another format."""
    from servotwin.record import convert as run

    run(log, output)


@app.command()
def identify(
    log: Annotated[Path, typer.Argument(help="A .csv, .npz or .parquet with time_s, position_m, theta_m_rad ...")],
    servo: Annotated[
        str | None, typer.Option(help="A preset's name or a servo's TOML; the log's own by default.")
    ] = None,
    start: Annotated[float | None, typer.Option(help="One window from here on, s; not one per step.")] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of that window, s; to the log's end by default.")
    ] = None,
    window: Annotated[
        float | None, typer.Option(help="Length of the windows at the steps, s; the log's, or 1.")
    ] = None,
    pre_trigger: Annotated[float | None, typer.Option(help="How much of it lies before the step, s.")] = None,
    method: Annotated[str, typer.Option(help="whitened or paper.")] = "whitened",
    wear_deg: Annotated[float | None, typer.Option(help="The gap grows by about so much ...")] = None,
    wear_over_s: Annotated[float | None, typer.Option(help="... in so long; 0.2 deg/s by default.")] = None,
    gap_limit_deg: Annotated[float | None, typer.Option(help="Tell how long until the gap is that large.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
) -> None:
    """The gap and its trend from a recorded log."""
    from servotwin.identification import Request, tell

    cut = (start, duration, window, pre_trigger)
    tell(Request(log, servo, *cut, method, wear_deg, wear_over_s, gap_limit_deg), json)


@app.command()
def bench(
    workloads: Annotated[
        list[str] | None,
        typer.Argument(
            help="W1, W2, W3, sampled, decision, start (all by default); or one of estimator, hostile, policies, tick, "
            "novelty, fleet."
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write every run into this .json file.")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Rounds; 7 by default.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small workloads, to see that all works.")] = False,
    full: Annotated[bool, typer.Option("--full", help="fleet: five minutes, and an outage of ten.")] = False,
    slow: Annotated[bool, typer.Option("--slow", help="Also what takes many seconds a run: scipy, compiling.")] = False,
    reference: Annotated[Path | None, typer.Option(help="An .npz with W1's true q3, to compare with.")] = None,
) -> None:
    """Speed and accuracy beside what one would use instead, side by side."""
    from datetime import UTC, datetime

    from servotwin.bench.alone import run_alone

    date = datetime.now(UTC).isoformat(timespec="seconds")
    others = slow or runs is not None or reference is not None
    if run_alone(tuple(workloads or ()), date, json, quick, others, full):
        return
    from servotwin.bench.catalogue import Options
    from servotwin.bench.command import bench as run

    run(tuple(workloads or ()), date, json, runs, Options(quick, slow, reference))


@app.command()
def edge(file: Annotated[Path, typer.Argument(help="The servo's edge.toml.")]) -> None:
    """Run one servo's edge until a signal ends it; where nothing but it is installed: python -m servotwin.gateway."""
    from servotwin.gateway.run import run

    run(file)


@app.command("limit-cycle")
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
    from servotwin.redesign.cycletable import tell

    tell(servo, gap_deg, tolerance_mm, step_mm, enter, leave, json)


@app.command()
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
    from servotwin.redesign.tunetable import Request, tell

    tell(Request(servo, kind, crossover, phase_margin_deg, ms_max, prefer, delay_ms, b, c), json)


@app.command("map")
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
    from servotwin.maps.command import stability_map
    from servotwin.maps.request import Request

    axes = (tolerance, amplitude, gap_deg, estimate_deg, k_dz, amplitude_mm)
    runs = (members, motion, seed, duration, window, still_um)
    stability_map(Request(servo, *axes, enter, leave, *runs), out, workers, scheduler)


@app.command()
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
    from servotwin.certification import certify as run
    from servotwin.certification import grid_of

    run(file, model, out, grid_of(finest_deg, bias_mv, noise_um))


@app.command()
def up(
    folder: Annotated[Path, typer.Option(help="Where all is kept; made at the first start.")] = Path("servotwin-up"),
    speed: Annotated[
        float | None, typer.Option(help="Times real time; as fast as 60 % of two cores allow by default.")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", help="End by itself after so many s.")] = None,
) -> None:
    """Everything at once on this machine: a twin, and three simulated servos that wear; Ctrl-C ends it."""
    from servotwin.up.command import up as run

    run(folder, speed, seconds)


@app.command()
def twin(
    config: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Instead of the file's; 0: any free one.")] = None,
) -> None:
    """The twin as a service: windows come in over HTTP, estimates are made and stored, updates go out."""
    from servotwin.service.command import run

    run(config, port)


@app.command()
def enroll(
    name: Annotated[str, typer.Argument(help="The servo's name, or the operator's.")],
    twin: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
    edge: Annotated[Path | None, typer.Option(help="The edge's folder; the servo's name by default.")] = None,
    role: Annotated[str, typer.Option(help="control: the edge ticks; supervise: the drive does.")] = "supervise",
    sample_rate_hz: Annotated[float, typer.Option(help="Of the edge.")] = 5000.0,
    drive: Annotated[Path | None, typer.Option(help="A TOML with the table [drive]; a simulated one without.")] = None,
    url: Annotated[str | None, typer.Option(help="Where the edge reaches the twin; its own address without.")] = None,
    operator: Annotated[Path | None, typer.Option(help="Enroll an operator instead; the token goes here.")] = None,
    again: Annotated[bool, typer.Option("--again", help="Replace the token that there is.")] = False,
) -> None:
    """Make a servo known to the twin: a token of its own, and a folder with all that its edge needs."""
    from servotwin import provision

    if operator is not None:
        made = provision.enroll_operator(twin, name, operator, again)
    else:
        wanted = name, edge or Path(name), role, sample_rate_hz, provision.drive_of(drive), url, again
        made = provision.enroll(twin, provision.Enrolment(*wanted))
    for path in made:
        print(f"written: {path}")


@app.command()
def audit(
    servo: Annotated[str, typer.Argument(help="The servo's name.")],
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    url: Annotated[str | None, typer.Option(help="Ask a service instead: https://twin:8765.")] = None,
    token: Annotated[Path | None, typer.Option(help="A file with an operator's token, for the service.")] = None,
    ca: Annotated[Path | None, typer.Option(help="Certificates that the service's is checked against.")] = None,
    limit: Annotated[int, typer.Option(min=1, max=1000, help="Windows at most.")] = 20,
    changes: Annotated[bool, typer.Option("--changes", help="Only windows from which something followed.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON array of the windows instead of lines.")] = False,
) -> None:
    """The evidence chain of a servo: window, estimate, version, receipt, effect."""
    from servotwin.service.auditing import Source
    from servotwin.service.auditing import audit as run

    run(servo, Source(config, url, token, ca), limit, changes, json)


@app.command()
def replay(
    servo: Annotated[str, typer.Argument(help="The servo's name.")],
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    window: Annotated[str | None, typer.Option(help="Only this one: BOOT/NUMBER.")] = None,
    present: Annotated[
        bool, typer.Option("--present", help="With model and settings as the twin's file has them now.")
    ] = False,
) -> None:
    """Make stored estimates again: the same bit for bit, or what differs since then; exit code 1 if any is not."""
    from servotwin.service.replaytext import tell

    if not tell(servo, config, window, present):
        raise typer.Exit(1)


@app.command()
def backup(
    to: Annotated[Path, typer.Argument(help="The file to be written.")],
    config: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
) -> None:
    """Copy the twin's SQLite store as it is at one moment, while the twin runs on."""
    from servotwin.service.keeping import back_up

    back_up(config, to)


@app.command()
def restore(
    backed_up: Annotated[Path, typer.Argument(help="What `servotwin backup` wrote.")],
    config: Annotated[Path, typer.Option(help="The twin's file; its store must not exist, or be empty.")] = Path(
        "twin.toml"
    ),
) -> None:
    """Put a backup in the place of the twin's store."""
    from servotwin.service.keeping import put_back

    put_back(config, backed_up)


def main() -> None:
    """Entry point of the `servotwin` command."""
    app()


if __name__ == "__main__":
    main()
