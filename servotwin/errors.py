"""What servotwin raises when the user's input is at fault."""


class InvalidInput(ValueError):
    """One sentence that names the offending file, key, value and unit, and says what is allowed.

    The command line shows it without a traceback and ends with exit code 2.
    """
