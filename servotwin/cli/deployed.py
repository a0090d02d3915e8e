"""Commands of deployed machines: edges, their twin, and what it has stored."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def edge(file: Annotated[Path, typer.Argument(help="The servo's edge.toml.")]) -> None:
    """Run one servo's edge until a signal ends it. Without the command line: python -m servotwin.edge_process."""
    from servotwin.edge_process.run import run

    run(file)


def up(
    folder: Annotated[Path, typer.Option(help="Where all is kept; made at the first start.")] = Path("servotwin-up"),
    speed: Annotated[
        float | None, typer.Option(help="Times real time; as fast as 60 % of two cores allow by default.")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", help="End by itself after so many s.")] = None,
) -> None:
    """Everything at once on this machine: a twin, and three simulated servos that wear; Ctrl-C ends it."""
    from servotwin.runtime.extras import check_extra
    from servotwin.up.command import up as run

    for module in ("uvicorn", "httptools", "sqlalchemy", "alembic"):  # the twin is a process of its own
        check_extra(module, "servotwin up")

    run(folder, speed, seconds)


def twin(
    config: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Instead of the file's; 0: any free one.")] = None,
) -> None:
    """The twin as a service: windows come in over HTTP, estimates are made and stored, updates go out."""
    from servotwin.twin_service.command import run

    run(config, port)


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
    noise_um: Annotated[float, typer.Option(min=0.0, help="On the measured position, rms: the watch allows it.")] = 0.0,
    ca: Annotated[Path | None, typer.Option(help="What the edge checks the twin's certificate against.")] = None,
) -> None:
    """Make a servo known to the twin: a token of its own, and a folder with all that its edge needs."""
    from servotwin.up import enrolment

    if operator is not None:
        made = enrolment.enroll_operator(twin, name, operator, again)
    else:
        told = enrolment.drive_of(drive), url, again, noise_um * 1e-6, ca
        wanted = name, edge or Path(name), role, sample_rate_hz, *told
        made = enrolment.enroll(twin, enrolment.Enrolment(*wanted))
    for path in made:
        print(f"written: {path}")


def revoke(
    name: Annotated[str, typer.Argument(help="The servo's name, or the operator's.")],
    twin: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
) -> None:
    """Take a token back: the twin refuses it within a second, what it has stored stays."""
    from servotwin.up import enrolment

    print(f"written: {enrolment.revoke(twin, name)}")


def servos(
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    url: Annotated[str | None, typer.Option(help="Ask a service instead: https://twin:8765.")] = None,
    token: Annotated[Path | None, typer.Option(help="A file with an operator's token, for the service.")] = None,
    ca: Annotated[Path | None, typer.Option(help="Certificates that the service's is checked against.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON array instead of lines.")] = False,
) -> None:
    """Every servo at a glance: gap, version, receipt, what waits, when it was last heard of."""
    from servotwin.cli.audit import Source
    from servotwin.cli.audit import servos as run

    run(Source(config, url, token, ca), json)


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
    from servotwin.cli.audit import Source
    from servotwin.cli.audit import audit as run

    run(servo, Source(config, url, token, ca), limit, changes, json)


def replay(
    servo: Annotated[str, typer.Argument(help="The servo's name.")],
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    window: Annotated[str | None, typer.Option(help="Only this one: BOOT/NUMBER.")] = None,
    present: Annotated[
        bool, typer.Option("--present", help="With model and settings as the twin's file has them now.")
    ] = False,
) -> None:
    """Make stored estimates again: the same bit for bit, or what differs since then; exit code 1 if any is not."""
    from servotwin.cli.replay import tell

    if not tell(servo, config, window, present):
        raise typer.Exit(1)


def backup(
    to: Annotated[Path, typer.Argument(help="The file to be written.")],
    config: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
) -> None:
    """Copy the twin's SQLite store as it is at one moment, while the twin runs on."""
    from servotwin.cli.backup import back_up

    back_up(config, to)


def restore(
    backed_up: Annotated[Path, typer.Argument(help="What `servotwin backup` wrote.")],
    config: Annotated[Path, typer.Option(help="The twin's file; its store must not exist, or be empty.")] = Path(
        "twin.toml"
    ),
) -> None:
    """Put a backup in the place of the twin's store."""
    from servotwin.cli.backup import put_back

    put_back(config, backed_up)
