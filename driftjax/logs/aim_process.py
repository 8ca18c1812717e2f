"""Child process of `driftjax.logs.aim`: read an AiM file within a limit of memory; its channels go to stdout as NPZ."""

import io
import resource
import sys

import numpy as np


def main(path: str, most_memory: int) -> None:
    """Write name, unit, time [s] and samples of every channel of the file `path`."""
    resource.setrlimit(resource.RLIMIT_AS, (most_memory, most_memory))
    stdout, sys.stdout = sys.stdout, sys.stderr
    from libxrk import ChannelMetadata, aim_xrk  # within the limit

    arrays: dict[str, np.ndarray] = {}
    for name, table in aim_xrk(path).channels.items():
        k = len(arrays) // 3
        arrays[f"name{k}"] = np.array([name, ChannelMetadata.from_channel_table(table).units])
        arrays[f"t{k}"] = table.column("timecodes").to_numpy() / 1000
        arrays[f"y{k}"] = np.asarray(table.column(name).to_numpy(), float)
    np.savez(buffer := io.BytesIO(), **arrays)  # type: ignore[arg-type]
    stdout.buffer.write(buffer.getvalue())


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
