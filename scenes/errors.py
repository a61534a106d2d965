"""The one error a specification can raise."""


class SpecError(ValueError):
    """A specification file is missing, unreadable or impossible.

    The message names the file, the key and the remedy, on one line.
    """
