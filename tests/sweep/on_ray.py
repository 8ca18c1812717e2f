"""A sweep on a Ray cluster of two nodes on this machine, one of which is lost: python -m tests.sweep.on_ray PATH"""

import sys
import threading
import time
from pathlib import Path

from ray.cluster_utils import Cluster

from tests.sweep.test_sweep import config_of, run


def main(path: Path) -> None:
    """Kill the second node as soon as a trial has begun."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node, trace = cluster.add_node(num_cpus=1), path / "trace"
    path.mkdir(parents=True)

    def kill_when_busy() -> None:
        while not trace.exists():
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)

    threading.Thread(target=kill_when_busy, daemon=True).start()
    run(path, config_of(base={"trace": str(trace), "pause": 0.1}), ray=cluster.address)
    cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
