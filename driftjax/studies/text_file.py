"""Write the text files of a study."""

from pathlib import Path

from driftjax.core import write_atomically


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` in UTF-8; after an interruption the file is the old one or the new one, never a part."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
