"""Executors of chunks of trials: this process, worker processes, or a Ray cluster."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol

from driftjax.core import BadInput
from driftjax.logs.extras import import_extra
from driftjax.parallel import apply_settings, process_pool, settings

# What a process must find before JAX is imported, so that it computes as this one does.
ENVIRONMENT = ("NPROC", "OPENBLAS_NUM_THREADS", "JAX_PLATFORMS", "XLA_FLAGS", "PYTHONPATH")


class Executor(Protocol):
    """Run functions defined at module level."""

    @property
    def slots(self) -> int:
        """Number of chunks to submit at once."""
        ...

    @property
    def batched(self) -> bool:
        """Whether trials should come in batches."""
        ...

    def submit(self, function: Callable, *args: Any) -> Future:
        """Submit `function(*args)`."""
        ...

    def restart(self) -> None:
        """Replace workers that died."""
        ...


class InProcessExecutor:
    """Run in this process at once; a batch of trials where `batched`."""

    slots = 1

    def __init__(self, batched: bool):
        self.batched = batched

    def submit(self, function: Callable, *args: Any) -> Future:
        """Run the function; the future is done on return."""
        future: Future = Future()
        future.set_result(function(*args))
        return future

    def restart(self) -> None:
        """Do nothing: there are no workers."""


class ProcessExecutor:
    """Run in worker processes; one chunk waits for each."""

    batched = False

    def __init__(self, num: int, stack: ExitStack):
        self.num, self.slots, self._stack = num, 2 * num, stack
        self._pool = stack.enter_context(process_pool(num))

    def submit(self, function: Callable, *args: Any) -> Future:
        """Submit to the first free process."""
        return self._pool.submit(function, *args)

    def restart(self) -> None:
        """Replace the whole pool, which a dead worker broke; running chunks are lost."""
        self._stack.close()
        self._pool = self._stack.enter_context(process_pool(self.num))


class RayExecutor:
    """Run on a Ray cluster, one core per worker; chunks of a lost worker or node are retried elsewhere."""

    batched = False

    def __init__(self, address: str):
        ray = import_extra("--ray", "Ray", "ray", "ray")
        environment = {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error", runtime_env={"env_vars": environment})
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            words = " ".join(str(error).split())[:200]
            raise BadInput(f"--ray {address}: no cluster there ({words}); start one with `ray start --head`.") from None
        self._ray, self._remote = ray, ray.remote(num_cpus=1, max_retries=-1)(_in_worker)
        self._settings = settings()

    @property
    def slots(self) -> int:
        """Two for each core that the cluster has now."""
        return 2 * max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def submit(self, function: Callable, *args: Any) -> Future:
        """Submit to the first free core."""
        return self._remote.remote(self._settings, function, args).future()

    def restart(self) -> None:
        """Do nothing: Ray replaces workers itself."""

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


def _in_worker(known: dict[str, Any], function: Callable, args: tuple) -> Any:
    apply_settings(known)
    return function(*args)


@contextmanager
def executor(num: int, ray: str | None, batched: bool = False) -> Iterator[Executor]:
    """Open an executor: the cluster at address `ray`, `num` worker processes, or this process where `num` is 0."""
    with ExitStack() as stack:
        if ray is not None:
            cluster = RayExecutor(ray)
            stack.callback(cluster.close)
            yield cluster
        else:
            yield ProcessExecutor(num, stack) if num else InProcessExecutor(batched)
