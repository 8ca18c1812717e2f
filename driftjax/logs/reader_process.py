"""Child process of `driftjax.logs.isolated`: run one reader within a limit of memory; its arrays go to stdout as NPZ.

A reader is a script with a function `read_arrays(path, content)` that returns arrays by name; it imports nothing of
driftjax, which takes seconds.
"""

import ctypes
import importlib.util
import io
import os
import resource
import signal
import sys

import numpy as np

PR_SET_PDEATHSIG = 1


def main(script: str, path: str, most_memory: int, parent: int) -> None:
    """Write what the reader in `script` returns of the file `path`, whose bytes may come from stdin."""
    resource.setrlimit(resource.RLIMIT_AS, (most_memory, most_memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # which died before
            return
    content = sys.stdin.buffer.read()
    stdout, sys.stdout = sys.stdout, sys.stderr
    spec = importlib.util.spec_from_file_location("reader", script)
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(module := importlib.util.module_from_spec(spec))
    np.savez(buffer := io.BytesIO(), **module.read_arrays(path, content))
    stdout.buffer.write(buffer.getbuffer())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
