"""The one exception that means: what you gave us is wrong, and here is what and where."""

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input from outside: names the argument (or file) and the offending value, in one line.

    The command line turns it into one line on standard error and exit code 2. Every other exception is a defect
    of this software and keeps its traceback.
    """
