"""`driftjax play RUN`: open the report of a run in the browser, or export its cars."""

import dataclasses
import webbrowser
from pathlib import Path

import tyro

from driftjax.cli.console import parse
from driftjax.core import require
from driftjax.report import save_film, write_page
from driftjax.store import RunFolder


@dataclasses.dataclass(frozen=True)
class PlayOptions:
    """Open the report of a run of `learn`, `diagnose` or `compare` in the browser; with a file below, write that."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    mcap: Path | None = None
    """MCAP file with Foxglove's Protobuf schemas; needs the extra `mcap`."""
    gif: Path | None = None
    """Animated GIF, of the corner for laps."""
    mp4: Path | None = None
    """The same as MP4; needs ffmpeg."""
    show: str | None = None
    """Plant of a run of `learn`, or measured run of a diagnosis, that goes into the files; left out: the first."""


def run(argv: list[str]) -> int:
    """Open or export."""
    flags = parse(PlayOptions, argv, "driftjax play")
    folder = RunFolder.open(flags.run)
    files = {".mcap": flags.mcap, ".gif": flags.gif, ".mp4": flags.mp4}
    if not any(files.values()):
        require(flags.show is None, "key 'show': it selects what goes into a file; add --mcap, --gif or --mp4.")
        return open_report(folder)
    for suffix, path in files.items():
        require(path is None or path.suffix == suffix, f"--{suffix[1:]} {path}: the name must end in {suffix}.")
    print("\n".join(save_film(folder, *filter(None, files.values()), show=flags.show)))
    return 0


def open_report(folder: RunFolder) -> int:
    """Open report.html, written first where it is missing."""
    page = folder.path / "report.html"
    if not page.is_file():
        write_page(folder)
    opened = webbrowser.open(page.resolve().as_uri())
    print(f"report: {page}" if opened else f"report: {page} (no browser was found here; open this file in one)")
    return 0
