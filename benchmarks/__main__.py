"""Run the benchmarks: `python -m benchmarks`."""

from __future__ import annotations

import sys

from servotwin.cli.app import main

if __name__ == "__main__":
    sys.argv[1:1] = ["bench"]
    main()
