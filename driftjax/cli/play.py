"""`driftjax play RUN`: open the report of a run in the browser, or export its cars."""

import dataclasses
import webbrowser
from pathlib import Path

import tyro

from driftjax.cli.console import parse
from driftjax.core import BadInput, require
from driftjax.report import write_page
from driftjax.report.drives import film_pairs, run_drives, shown_together, shown_vehicle
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
    films = [path for path in (flags.gif, flags.mp4) if path is not None]
    if flags.mcap is None and not films:
        require(flags.show is None, "key 'show': it selects what goes into a file; add --mcap, --gif or --mp4.")
        return open_report(folder)
    for path, suffix in ((flags.gif, ".gif"), (flags.mp4, ".mp4"), (flags.mcap, ".mcap")):
        if path is not None and path.suffix != suffix:
            raise BadInput(f"--{suffix[1:]} {path}: the name must end in {suffix}.")
        if path is not None and not path.parent.is_dir():
            raise BadInput(f"{path}: the folder {path.parent} does not exist; make it first.")
    every, plan = run_drives(folder)
    drives, vehicle = shown_together(every, flags.show), shown_vehicle(folder)
    if flags.mcap is not None:
        from driftjax.report.foxglove import write_mcap

        counts = write_mcap(flags.mcap, vehicle, drives, plan)
        print(f"{flags.mcap}: {drives[0].group}, {sum(counts.values())} messages on {len(counts)} topics")
    for path in films:
        from driftjax.report.animation import animate

        num = animate(path, vehicle, film_pairs(drives), plan)
        print(f"{path}: {drives[0].group}, {num} frames, {path.stat().st_size / 1e6:.2f} MB")
    return 0


def open_report(folder: RunFolder) -> int:
    """Open report.html, written first where it is missing."""
    page = folder.path / "report.html"
    if not page.is_file():
        write_page(folder)
    opened = webbrowser.open(page.resolve().as_uri())
    print(f"report: {page}" if opened else f"report: {page} (no browser was found here; open this file in one)")
    return 0
