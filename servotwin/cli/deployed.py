"""Commands of deployed machines: edges, their twin and its store."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from servotwin.errors import InvalidInput

_Config = Annotated[Path, typer.Option("--config", "--twin", help="The twin's file.")]


def edge(file: Annotated[Path, typer.Argument(help="The servo's edge.toml.")]) -> None:
    """Run one servo's edge until a signal ends it. On the edge's computer: python -m servotwin.edge_process."""
    from servotwin.edge_process.run import run

    run(file)


def up(
    scenarios: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Scenario files whose machines run, in real time; by default three servos that wear, as a "
            "demonstration, or those of the folder.",
        ),
    ] = None,
    machines: Annotated[int, typer.Option(help="Machines of each scenario, named NAME-1, NAME-2, ...")] = 1,
    folder: Annotated[Path, typer.Option(help="Folder for all stored data; created at the first start.")] = Path(
        "servotwin-up"
    ),
    speed: Annotated[
        float | None,
        typer.Option(
            help="Speed in multiples of real time; by default 1 for scenarios, and otherwise as fast as 60 % of two "
            "cores allow."
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", help="End after this many seconds.")] = None,
) -> None:
    """Run a twin, edges and simulated machines that wear, all as processes on this machine; Ctrl-C ends it."""
    from servotwin.runtime.extras import check_extra
    from servotwin.up.command import up as run

    for module in ("uvicorn", "httptools", "sqlalchemy", "alembic"):  # the twin is a process of its own
        check_extra(module, "servotwin up")

    run(folder, scenarios or (), machines, speed, seconds)


class TwinAction(StrEnum):
    """Action of `servotwin twin` instead of serving."""

    CHECK = "check"
    ALARM = "test-alarm"


def twin(
    action: Annotated[
        str | None,
        typer.Argument(
            metavar="check|test-alarm",
            help="Instead of serving. check: check the whole store, even while the twin runs. "
            "test-alarm: post a test to the webhook in the file's table service.webhook. --config names the file.",
        ),
    ] = None,
    config: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port instead of the file's; 0: any free port.")
    ] = None,
) -> None:
    """Run the twin as a service: it receives windows, stores estimates and sends updates."""
    if action is not None and action not in list(TwinAction):
        raise InvalidInput(
            f"servotwin twin {action}: the argument says what to do instead of serving ({', '.join(TwinAction)}); the "
            "twin's file is given with --config"
        )
    if action == TwinAction.CHECK:
        from servotwin.cli.check import check_store

        check_store(config)
        return
    if action == TwinAction.ALARM:
        from servotwin.cli.alarm_test import post_test_alarm

        post_test_alarm(config)
        return
    from servotwin.twin_service.command import run

    run(config, port)


def enroll(
    name: Annotated[str | None, typer.Argument(help="Name of the servo, operator or engineer; not with --csv.")] = None,
    config: _Config = Path("twin.toml"),
    csv: Annotated[
        Path | None,
        typer.Option(
            help="Enroll a servo for each row, all or none. Columns: name, and optionally edge, role, sample_rate_hz, "
            "drive, url, noise_um or noise_mdeg, ca, which default to the options of those names."
        ),
    ] = None,
    edge: Annotated[Path | None, typer.Option(help="Folder of the edge; by default the servo's name.")] = None,
    role: Annotated[
        str, typer.Option(help="control: the edge runs the controller; supervise: the drive does.")
    ] = "supervise",
    sample_rate_hz: Annotated[
        float | None,
        typer.Option(help="Sample rate of the edge, Hz; by default that of the servo's controller, or 5000."),
    ] = None,
    drive: Annotated[
        Path | None, typer.Option(help="TOML file with the table drive; by default a simulated drive.")
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="Address at which the edge reaches the twin; by default the twin's own.")
    ] = None,
    operator: Annotated[
        Path | None, typer.Option(help="Enroll an operator, who may read, and write the token to this file.")
    ] = None,
    engineer: Annotated[
        Path | None,
        typer.Option(help="Enroll an engineer, who may also hold, approve and roll back; file for the token."),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Replace an existing token.")] = False,
    noise_um: Annotated[
        float, typer.Option(min=0.0, help="Rms noise of the measured position that the edge's watch tolerates, um.")
    ] = 0.0,
    noise_mdeg: Annotated[
        float, typer.Option(min=0.0, help="The same of a rotary axis, thousandths of a degree.")
    ] = 0.0,
    ca: Annotated[Path | None, typer.Option(help="Certificates with which the edge checks the twin's.")] = None,
) -> None:
    """Enroll a servo: write its token and a folder with everything that its edge needs."""
    from servotwin.up import enrolment
    from servotwin.up.bulk_enrolment import enroll_all, read_enrolments

    if (name is None) == (csv is None) or (csv is not None and (edge or operator or engineer)):
        raise InvalidInput("give a name, or --csv with a file; --edge, --operator and --engineer are for one name")
    if noise_um and noise_mdeg:
        raise InvalidInput("give --noise-um, or --noise-mdeg of a rotary axis")
    if operator is not None and engineer is not None:
        raise InvalidInput("give --operator or --engineer: a name has one role")
    folders = list[Path]()
    if operator is not None or engineer is not None:
        file = operator or engineer or Path()
        written = enrolment.enroll_operator(config, name or "", file, again, engineer=engineer is not None)
    else:
        request = enrolment.Enrolment(
            servo=name or "",
            folder=edge or Path(name or ""),
            role=role,
            sample_rate=sample_rate_hz,
            drive=enrolment.drive_of(drive),
            url=url,
            replace_token=again,
            noise=enrolment.StatedNoise(noise_mdeg, "mdeg") if noise_mdeg else enrolment.StatedNoise(noise_um),
            ca=ca,
        )
        if csv is not None:
            requests = read_enrolments(csv, request)
            folders, written = [each.folder for each in requests.values()], enroll_all(config, csv, requests)
        else:
            folders, written = [request.folder], enrolment.enroll(config, request)
    for path in written:
        print(f"written: {path}")
    new = set(written)
    for path in (folder / enrolment.CONFIG for folder in folders):
        if path not in new:
            print(f"kept: {path}, with the limits and options of its enrolment; for others give --edge a new folder")


def revoke(
    name: Annotated[str, typer.Argument(help="Name of the servo, operator or engineer.")],
    config: _Config = Path("twin.toml"),
) -> None:
    """Revoke a token: the twin refuses it within a second; stored data stays."""
    from servotwin.up import enrolment

    print(f"written: {enrolment.revoke(config, name)}")


def servos(
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    url: Annotated[str | None, typer.Option(help="Read from a service instead: https://twin:8765.")] = None,
    token: Annotated[Path | None, typer.Option(help="A file with an operator's token, for the service.")] = None,
    ca: Annotated[Path | None, typer.Option(help="Certificates with which the service's is checked.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON array instead of lines.")] = False,
) -> None:
    """List every servo: gap, status, version, receipt, pending messages, time of the last message."""
    from servotwin.cli.audit import Source
    from servotwin.cli.audit import servos as run

    run(Source(config, url, token, ca), json)


def audit(
    servo: Annotated[str, typer.Argument(help="The servo's name.")],
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    url: Annotated[str | None, typer.Option(help="Read from a service instead: https://twin:8765.")] = None,
    token: Annotated[Path | None, typer.Option(help="A file with an operator's token, for the service.")] = None,
    ca: Annotated[Path | None, typer.Option(help="Certificates with which the service's is checked.")] = None,
    limit: Annotated[int, typer.Option(min=1, max=1000, help="Largest number of windows.")] = 20,
    changes: Annotated[
        bool, typer.Option("--changes", help="Of these, only windows that led to more than an estimate.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON array of the windows instead of lines.")] = False,
    page: Annotated[
        Path | None, typer.Option(help="Write a report to mail instead: an HTML file with pictures inside.")
    ] = None,
) -> None:
    """Show the evidence chain of a servo: window, estimate, version, receipt, effect."""
    from servotwin.cli.audit import Source, write_report
    from servotwin.cli.audit import audit as run

    if page is not None:
        write_report(servo, Source(config, url, token, ca), page)
        return
    run(servo, Source(config, url, token, ca), limit, changes, json)


def replay(
    servo: Annotated[str, typer.Argument(help="The servo's name.")],
    config: Annotated[Path, typer.Option(help="The twin's file: its store is read.")] = Path("twin.toml"),
    window: Annotated[str | None, typer.Option(help="Only this window: BOOT/NUMBER.")] = None,
    present: Annotated[
        bool, typer.Option("--present", help="Use the model and settings that the twin's file has now.")
    ] = False,
) -> None:
    """Repeat stored estimates and compare them bit for bit; exit code 1 if any differs."""
    from servotwin.cli.replay import print_replay

    if not print_replay(servo, config, window, present):
        raise typer.Exit(1)


def backup(
    to: Annotated[Path, typer.Argument(help="File to write.")],
    config: Annotated[Path, typer.Option(help="The twin's file.")] = Path("twin.toml"),
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
) -> None:
    """Copy the twin's SQLite store as of one moment, while the twin runs on."""
    from servotwin.cli.backup import backup_store

    backup_store(config, to, replace)


def restore(
    backed_up: Annotated[Path, typer.Argument(help="Backup written by `servotwin backup`.")],
    config: Annotated[Path, typer.Option(help="The twin's file; its store must not exist, or be empty.")] = Path(
        "twin.toml"
    ),
) -> None:
    """Restore the twin's store from a backup."""
    from servotwin.cli.backup import restore_store

    restore_store(config, backed_up)
