"""`python -m servotwin.gateway edge.toml`: one servo's edge as a process; it needs no numbers library."""

from __future__ import annotations

import sys

from servotwin.errors import InvalidInput
from servotwin.gateway.run import run


def main(arguments: list[str]) -> int:
    """Run until the drive's run is over or a signal comes; 2: something in the configuration is not allowed."""
    if len(arguments) != 1:
        print("usage: python -m servotwin.gateway edge.toml", file=sys.stderr)
        return 2
    try:
        run(arguments[0])
    except InvalidInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
