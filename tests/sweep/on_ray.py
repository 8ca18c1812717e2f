"""A sweep on a Ray cluster of two nodes on this machine: python -m tests.sweep.on_ray PATH [kill]"""

import sys
import threading
import time
from pathlib import Path

from ray.cluster_utils import Cluster

from tests.sweep.test_sweep import config_of, run


def main(path: Path, kill: bool) -> None:
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node = cluster.add_node(num_cpus=1)
    trace = path / "trace"

    def kill_when_busy() -> None:
        while not trace.exists():
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)

    if kill:
        threading.Thread(target=kill_when_busy, daemon=True).start()
    base = {"trace": str(trace), "pause": 0.3} if kill else {}
    run(path, config_of(base=base), ray=cluster.address)
    cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]), len(sys.argv) > 2)
