"""Write the cars of a run as a film or a recording."""

from pathlib import Path

from driftjax.core import BadInput
from driftjax.report.drives import film_pairs, run_drives, shown_together, shown_vehicle
from driftjax.store import RunFolder

SUFFIXES = (".gif", ".mp4", ".mcap")


def save_film(folder: RunFolder | str | Path, *paths: str | Path, show: str | None = None) -> list[str]:
    """Write the cars of a run of learn or diagnose to each of `paths`, by its suffix as animated GIF, MP4 or MCAP.

    `show` names the plant or the measured run, the first one if omitted. Returns what each file holds, in words. Raises
    `BadInput` before anything is written for another suffix and for a missing folder, and where ffmpeg or the extra
    `mcap` is missing.
    """
    files = [Path(path) for path in paths]
    for path in files:
        if path.suffix not in SUFFIXES:
            raise BadInput(f"{path}: the name must end in {', '.join(SUFFIXES)}.")
        if not path.parent.is_dir():
            raise BadInput(f"{path}: the folder {path.parent} does not exist; make it first.")
    run = RunFolder.open(folder)
    every, plan = run_drives(run)
    drives, vehicle = shown_together(every, show), shown_vehicle(run)

    def save(path: Path) -> str:
        if path.suffix == ".mcap":
            from driftjax.report.foxglove import write_mcap

            counts = write_mcap(path, vehicle, drives, plan)
            return f"{path}: {drives[0].group}, {sum(counts.values())} messages on {len(counts)} topics"
        from driftjax.report.animation import animate

        num = animate(path, vehicle, film_pairs(drives), plan)
        return f"{path}: {drives[0].group}, {num} frames, {path.stat().st_size / 1e6:.2f} MB"

    return [save(path) for path in files]
