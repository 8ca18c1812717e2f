"""Run a reader in a process of its own: damaged files can crash its library or keep it busy."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from driftjax.logs.extras import one_line, unreadable

TIMEOUT = 300.0  # s
MOST_MEMORY = 8 * 2**30  # bytes
PROCESS = Path(__file__).with_name("reader_process.py")


def read_isolated(script: Path, path: Path, kind: str, remedy: str, content: bytes = b"") -> dict[str, np.ndarray]:
    """Return the arrays that `read_arrays(path, content)` of a script makes; raises `BadInput` if it fails or crashes.

    The process dies with this one (on Linux).
    """
    command = [sys.executable, "-P", PROCESS, script, path.resolve(), str(MOST_MEMORY), str(os.getpid())]
    try:
        done = subprocess.run(command, capture_output=True, input=content, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        raise unreadable(path, kind, f"reading it takes over {TIMEOUT:g} s", remedy) from None
    if done.returncode:
        said = "".join(done.stderr.decode("utf-8", "replace").split("\n")[-2:])
        crash = f"its library crashed, exit {done.returncode}"
        raise unreadable(path, kind, one_line(said) if said and done.returncode > 0 else crash, remedy)
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
        return dict(arrays)
