"""``python -m servotwin`` is the `servotwin` command."""

from servotwin.cli import main

main()
