"""The one error that a user can cause."""


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line: the file, the field, what was found, and what to do. Commands print it and exit with
    status 2.
    """
