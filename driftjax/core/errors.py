"""Bad input, told in one sentence."""


class BadInput(Exception):
    """What a person typed cannot be used; the message names file, row or key and the remedy (exit code 2)."""
