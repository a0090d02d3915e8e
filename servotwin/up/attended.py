"""`python -m servotwin.up.attended MODULE ARGUMENTS`: runs a module that ends when its standard input does.

Whoever starts it holds the other end of the pipe and never writes: when that process is gone, however it went, the
system closes the pipe. The module is then told to end as by SIGTERM, and its process group is killed where it does not.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import time
from threading import Thread

GRACE_S = 15.0
_STDIN = 0


def main(arguments: list[str]) -> None:
    """Run a module as `python -m` would."""
    Thread(target=_watch, name="attended", daemon=True).start()
    sys.argv = arguments
    runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)


def _watch() -> None:
    while os.read(_STDIN, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main(sys.argv[1:])
