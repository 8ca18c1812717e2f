"""Signature of functions that report the progress of long work."""

from collections.abc import Callable

ProgressReport = Callable[[str, float, int], None]  # what is done now, parts done, parts in all
