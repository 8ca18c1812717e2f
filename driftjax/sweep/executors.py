"""Executors of chunks of trials: this process, worker processes, or a Ray cluster."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from typing import Any

from driftjax.core import BadInput
from driftjax.environment import FUSED_RESULTS, with_flag
from driftjax.logs.extras import import_extra
from driftjax.parallel import apply_settings, process_pool, settings

# What a process must find before JAX is imported, so that it computes as this one does.
ENVIRONMENT = ("NPROC", "OPENBLAS_NUM_THREADS", "JAX_PLATFORMS", "XLA_FLAGS", "PYTHONPATH")


class ChunkExecutor:
    """Run functions in this process at once; a batch of trials where `batched`."""

    def __init__(self, batched: bool = False):
        self.batched = batched

    @property
    def slots(self) -> int:
        """Return the number of chunks to submit at once."""
        return 1

    def submit(self, function: Callable, *args: Any) -> Future:
        """Submit `function(*args)`, defined at module level; here the future is done on return."""
        future: Future = Future()
        future.set_result(function(*args))
        return future

    def restart(self) -> None:
        """Replace workers that died; by default there are none, or they are replaced already."""


class ProcessExecutor(ChunkExecutor):
    """Run in worker processes; one chunk waits for each."""

    def __init__(self, num: int, stack: ExitStack, fused: bool):
        super().__init__()
        self.num, self._stack, self._fused = num, stack, fused
        self._pool = stack.enter_context(process_pool(num, fused))

    @property
    def slots(self) -> int:
        """Return two chunks for each process."""
        return 2 * self.num

    def submit(self, function: Callable, *args: Any) -> Future:
        """Submit to the first free process."""
        return self._pool.submit(function, *args)

    def restart(self) -> None:
        """Replace the whole pool, which a dead worker broke; running chunks are lost."""
        self._stack.close()
        self._pool = self._stack.enter_context(process_pool(self.num, self._fused))


class RayExecutor(ChunkExecutor):
    """Run on a Ray cluster, one core per worker; chunks of a lost worker or node are retried elsewhere."""

    def __init__(self, address: str, fused: bool):
        super().__init__()
        ray = import_extra("--ray", "Ray", "ray", "ray")
        environment = {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
        if fused:
            environment["XLA_FLAGS"] = with_flag(environment.get("XLA_FLAGS", ""), FUSED_RESULTS)
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error", runtime_env={"env_vars": environment})
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            words = " ".join(str(error).split())[:200]
            raise BadInput(f"--ray {address}: no cluster there ({words}); start one with `ray start --head`.") from None
        self._ray, self._remote = ray, ray.remote(num_cpus=1, max_retries=-1)(_in_worker)
        self._settings = settings()

    @property
    def slots(self) -> int:
        """Return two chunks for each core that the cluster has now."""
        return 2 * max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def submit(self, function: Callable, *args: Any) -> Future:
        """Submit to the first free core."""
        return self._remote.remote(self._settings, function, args).future()

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


def _in_worker(known: dict[str, Any], function: Callable, args: tuple) -> Any:
    apply_settings(known)
    return function(*args)


@contextmanager
def open_executor(num: int, ray: str | None, batched: bool = False, fused: bool = False) -> Iterator[ChunkExecutor]:
    """Open an executor: the cluster at address `ray`, `num` worker processes, or this process where `num` is 0."""
    with ExitStack() as stack:
        if ray is not None:
            cluster = RayExecutor(ray, fused)
            stack.callback(cluster.close)
            yield cluster
        else:
            yield ProcessExecutor(num, stack, fused) if num else ChunkExecutor(batched)
