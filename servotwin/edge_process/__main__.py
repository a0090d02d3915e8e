"""`python -m servotwin.edge_process edge.toml`: one servo's edge as a process; it needs neither numpy nor numba."""

from __future__ import annotations

import sys

from servotwin.edge_process.run import run
from servotwin.errors import InvalidInput


def main(arguments: list[str]) -> int:
    """Run until the drive's run is over or a signal comes; return the exit code, 2 for an invalid configuration."""
    if len(arguments) != 1:
        print("usage: python -m servotwin.edge_process edge.toml", file=sys.stderr)
        return 2
    try:
        run(arguments[0])
    except InvalidInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
