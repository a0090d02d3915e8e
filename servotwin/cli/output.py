"""Standard output of a command: neither a full disk under it nor a pipe that was closed is a traceback."""

from __future__ import annotations

import errno
import io
import sys
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from rich.progress import Progress

DIFFERENT, INVALID, CLOSED = 1, 2, 141
"""Exit codes: of a result that is not as wanted; of an error; of a closed pipe, as a shell shows SIGPIPE."""


class _File(io.FileIO):
    """File that lets the command go on where it cannot be written, and remembers the error.

    A closed pipe alone is raised, and once: nobody reads what would follow.
    """

    error: OSError | None = None
    closed_pipe = False

    def write(self, data: Any) -> int:
        """Write what can be written; the rest is lost."""
        if not self.closed_pipe:
            try:
                return super().write(data)
            except OSError as error:
                self.error = self.error or error
                self.closed_pipe = error.errno == errno.EPIPE
                if self.closed_pipe:
                    raise
        return memoryview(data).nbytes


class CheckedOutput:
    """Standard output of this process, whose errors become an exit code at the end."""

    def __init__(self) -> None:
        text = sys.stdout
        self._file, self._text = _File(text.fileno(), "wb", closefd=False), text
        unbuffered = isinstance(text.buffer, io.FileIO)
        sys.stdout = self._text = io.TextIOWrapper(
            cast(IO[bytes], self._file if unbuffered else io.BufferedWriter(self._file)),
            encoding=text.encoding,
            errors=text.errors,
            line_buffering=cast(Any, text).line_buffering,
            write_through=cast(Any, text).write_through,
        )

    def exit_code(self, code: Any, alone: bool = False) -> Any:
        """Write the last of the output; return the exit code, instead of the command's own where output was lost.

        `alone`: without a command, which is an error whose help is the output.
        """
        with suppress(OSError):
            self._text.flush()
        error = self._file.error
        if error is None or not (alone or code in (None, 0, DIFFERENT)):  # an error of its own is said already
            return code
        if self._file.closed_pipe:
            return CLOSED
        done = "" if code else "; everything else was done"
        with suppress(OSError):  # a full disk under both
            print(f"error: the output could not be written ({error.strerror}){done}", file=sys.stderr, flush=True)
        return INVALID


def progress_bar() -> Progress:
    """Progress that vanishes at its end; on a terminal only, since elsewhere it would leave an empty line."""
    from rich import get_console
    from rich.progress import Progress

    return Progress(transient=True, disable=not get_console().is_terminal)


def checked_output() -> CheckedOutput | None:
    """Check standard output from now on; None where it is closed or no file, as a console of Windows."""
    buffer = getattr(sys.stdout, "buffer", None)
    return CheckedOutput() if isinstance(getattr(buffer, "raw", buffer), io.FileIO) else None
