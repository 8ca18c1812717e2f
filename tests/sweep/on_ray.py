"""A sweep on a Ray cluster of two nodes here, one of which is lost again and again: python -m tests.sweep.on_ray PATH
TRIALS KILLS"""

import sys
import threading
import time
from pathlib import Path

import numpy as np
from ray.cluster_utils import Cluster

from tests.sweep.test_sweep import config_of, numbered, run


def main(path: Path, trials: int, kills: int) -> None:
    """Kill the second node as soon as a trial has begun, then others in its place at random moments."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node, trace = cluster.add_node(num_cpus=1), path / "trace"
    path.mkdir(parents=True)
    done = threading.Event()

    def kill_when_busy() -> None:
        nonlocal node
        while not trace.exists():
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)
        for pause in np.random.default_rng(0).uniform(0.2, 4.0, kills - 1):
            node = cluster.add_node(num_cpus=1)
            if done.wait(pause):
                raise SystemExit("the sweep ended before all kills")
            cluster.remove_node(node, allow_graceful=False)
        print(f"{kills} nodes killed", flush=True)

    killer = threading.Thread(target=kill_when_busy)
    killer.start()
    run(path, config_of(fields=numbered(trials), base={"trace": str(trace), "pause": 0.1}), ray=cluster.address)
    done.set()
    killer.join()
    cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
