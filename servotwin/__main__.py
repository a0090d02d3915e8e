"""``python -m servotwin`` is the `servotwin` command."""

from servotwin.cli.app import main

if __name__ == "__main__":
    main()
