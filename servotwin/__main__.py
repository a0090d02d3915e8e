"""``python -m servotwin`` is the `servotwin` command."""

import os
import signal
import sys
from typing import Any

_INTERRUPTED = 130


def main() -> None:
    """Run the command."""
    # An exception may make an import fail in any way; nothing is open yet, so that an interrupt just ends the process.
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:
        signal.signal(signal.SIGINT, _leave)
    from servotwin.cli.app import command_line
    from servotwin.cli.output import checked_output

    run, output = command_line(), checked_output()
    if interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run()
    except SystemExit as end:
        if end.code == _INTERRUPTED:
            # Python remembers an interrupt inside of `exec` (as in a compilation) and would end by the signal; another
            # `exec` makes it forget.
            exec("")
        if output is not None:
            end.code = output.exit_code(end.code, alone=len(sys.argv) < 2)
        raise


def _leave(_number: int, _frame: Any) -> None:
    os.write(sys.stderr.fileno(), b"interrupted; no partly written file is left\n")
    os._exit(_INTERRUPTED)


if __name__ == "__main__":
    main()
