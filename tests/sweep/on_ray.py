"""A sweep on a Ray cluster of two nodes here, one of which is lost again and again: python -m tests.sweep.on_ray PATH
TRIALS KILLS"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from ray.cluster_utils import Cluster

from tests.sweep.test_sweep import config_of, numbered, run


def main(path: Path, trials: int, kills: int) -> None:
    """Kill the second node as soon as a trial has begun, then others in its place at random moments."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node = cluster.add_node(num_cpus=1)
    path.mkdir(parents=True)
    child = subprocess.Popen([sys.executable, "-m", "tests.sweep.on_ray", str(path), str(trials), str(cluster.address)])
    while not (path / "trace").exists():
        time.sleep(0.05)
    cluster.remove_node(node, allow_graceful=False)
    for pause in np.random.default_rng(0).uniform(0.2, 4.0, kills - 1):
        node = cluster.add_node(num_cpus=1)
        time.sleep(pause)
        if child.poll() is not None:
            sys.exit("the sweep ended before all kills")
        cluster.remove_node(node, allow_graceful=False)
    print(f"{kills} nodes killed", flush=True)
    code = child.wait()
    cluster.shutdown()
    sys.exit(code)


def sweep_on(path: Path, trials: int, address: str) -> None:
    """The sweep, in a process that no signal of the cluster's reaches."""
    run(path, config_of(fields=numbered(trials), base={"trace": str(path / "trace"), "pause": 0.1}), ray=address)


if __name__ == "__main__":
    where, num, last = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    main(where, num, int(last)) if last.isdecimal() else sweep_on(where, num, last)
