"""The error for invalid user input."""


class BadInput(Exception):
    """Invalid user input; the message is one sentence that names file, row or key and the remedy (exit code 2)."""
