"""The command line. Nothing heavy is imported until a command runs, so that help and errors come at once.

A new command is a function in `commands` that imports what it needs in its body, and a line in the table below. User
errors are raised as `InvalidInput` anywhere below; `_Commands` turns them, and errors of usage, into one sentence and
exit code 2, and an interrupt into 130, another signal into 128 and its number.
"""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Annotated, Any, cast

import typer
from typer.core import TyperGroup

from servotwin.cli import deployed, design, study
from servotwin.errors import InvalidInput, ResourceUnavailable
from servotwin.runtime.extras import EXTRAS, missing_extra

INVALID, INTERRUPTED = 2, 130
_PATHS = (errno.ENAMETOOLONG, errno.ELOOP)
"""Errors of a path that a test whether it exists raises too."""
_INTERRUPT = "interrupted; no partly written file is left"

# Before numpy is loaded: matrices are small here, and OpenBLAS's threads only wait for one another. On two busy cores
# some thousand exponentials of 4 x 4 matrices took 24 s of processor time with two threads and 0.03 s with one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


# Typer exports its subclass only. An unknown option, a missing argument, a value of another type.
_UsageError: Any = typer.BadParameter.__base__
_SUGGESTION = re.compile(r"\.? \(?(?:Possible options:|Did you mean:?) (.*?)[?)]*$")


class _Commands(TyperGroup):
    """The group of all commands, with the one error handler."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (InvalidInput, ResourceUnavailable) as error:
            _end(f"error: {error}", INVALID)
        except OSError as error:
            if error.errno not in _PATHS or error.filename is None:
                raise
            _end(f"error: {str(error.filename)[:80]}: {error.strerror}", INVALID)
        except _UsageError as error:
            _end(_usage(error), INVALID)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in EXTRAS:
                raise
            _end(f"error: {missing_extra(str(error.name), f'servotwin {ctx.invoked_subcommand}')}", INVALID)
        except KeyboardInterrupt as interrupt:
            _end(str(interrupt) or _INTERRUPT, getattr(interrupt, "code", INTERRUPTED))

    def make_context(self, info_name: str | None, args: list[str], *others: Any, **options: Any) -> Any:
        alone = not args  # shows the help
        try:
            return super().make_context(info_name, args, *others, **options)
        except _UsageError as error:
            if alone:
                raise
            _end(_usage(error), INVALID)
        except KeyboardInterrupt:
            _end(_INTERRUPT, INTERRUPTED)


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A digital twin that keeps a motion controller tuned while its machine wears.",
)


def _end(message: str, code: int) -> None:
    with suppress(OSError):  # a log on a full disk: the code still says it
        print(message, file=sys.stderr, flush=True)
    raise typer.Exit(code) from None


def _usage(error: Any) -> str:
    """Make one sentence of an error of usage."""
    command = "servotwin" if error.ctx is None else error.ctx.command_path
    said = " ".join(error.format_message().split()).replace(": Value error, ", ": ")
    text = _SUGGESTION.sub(r" (did you mean \1?)", said).rstrip(".")
    return f"error: {command}: {text[:1].lower()}{text[1:]}; see {command} --help"


def _version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"servotwin {version('servotwin')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options of every command."""


COMMANDS: Mapping[str, Callable[..., None]] = {
    "demo": study.demo,
    "reproduce": study.reproduce,
    "simulate": study.simulate,
    "convert": study.convert,
    "identify": study.identify,
    "commission": study.commission,
    "dataset": study.dataset,
    "edge": deployed.edge,
    "limit-cycle": design.limit_cycle,
    "tune": design.tune,
    "map": design.map_,
    "certify": design.certify,
    "up": deployed.up,
    "twin": deployed.twin,
    "enroll": deployed.enroll,
    "revoke": deployed.revoke,
    "servos": deployed.servos,
    "audit": deployed.audit,
    "replay": deployed.replay,
    "backup": deployed.backup,
    "restore": deployed.restore,
}
"""As help lists them."""

for _name, _command in COMMANDS.items():
    app.command(_name)(_command)

# The benchmarks have a command line of their own.
app.command(
    "bench", context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
)(study.bench)


def command_line() -> Callable[[], None]:
    """Build the command line, which takes a tenth of a second; call it to run the command."""
    return cast(Callable[[], None], typer.main.get_command(app))


def main() -> None:
    """Run the command."""
    command_line()()
