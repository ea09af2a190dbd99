"""Errors that a user can mend: one line, no traceback, exit code 2."""


class UserError(Exception):
    """The config or the input is wrong. The text names the file, line or key, what was found, what was expected."""
