"""Error of servotwin for input that the user has to mend."""


class InvalidInput(ValueError):
    """One sentence that names the offending file, key, value and unit, and says what is allowed.

    The command line shows it without a traceback and ends with exit code 2.
    """
