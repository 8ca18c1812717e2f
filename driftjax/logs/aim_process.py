"""Reader of AiM files for `driftjax.logs.reader_process`."""

import numpy as np


def read_arrays(path: str, _content: bytes) -> dict[str, np.ndarray]:
    """Return name, unit, time [s] and samples of every channel of the file `path`."""
    from libxrk import ChannelMetadata, aim_xrk  # within the limit

    arrays: dict[str, np.ndarray] = {}
    for name, table in aim_xrk(path).channels.items():
        k = len(arrays) // 3
        arrays[f"name{k}"] = np.array([name, ChannelMetadata.from_channel_table(table).units])
        arrays[f"t{k}"] = table.column("timecodes").to_numpy() / 1000
        arrays[f"y{k}"] = np.asarray(table.column(name).to_numpy(), float)
    return arrays
