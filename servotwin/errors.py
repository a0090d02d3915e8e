"""Errors of servotwin that end a command with one sentence."""


class InvalidInput(ValueError):
    """One sentence that names the offending file, key, value and unit, and says what is allowed.

    The command line shows it without a traceback and ends with exit code 2.
    """


class ResourceUnavailable(RuntimeError):
    """One sentence on a resource that cannot be used now, such as a database; the command line treats it likewise."""
