"""The command line. Nothing heavy is imported until a command runs, so that help and errors come at once.

A new command is a function with ``@app.command()`` that imports what it needs in its body. User errors are raised as
`InvalidInput` anywhere below; `_Commands` turns them into one sentence and exit code 2, and an interrupt into 130.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from servotwin.errors import InvalidInput

INVALID, INTERRUPTED = 2, 130


class _Commands(TyperGroup):
    """The group of all commands, with the one error handler."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except InvalidInput as error:
            _end(f"error: {error}", INVALID)
        except KeyboardInterrupt:
            _end("interrupted; nothing half written was left behind", INTERRUPTED)


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


def main() -> None:
    """Entry point of the `servotwin` command."""
    app()


if __name__ == "__main__":
    main()
