"""Who runs chunks of trials: this process, worker processes beside it, or a Ray cluster."""

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
    """What runs functions that are a module's own."""

    @property
    def slots(self) -> int:
        """Chunks that are worth having under way."""
        ...

    @property
    def wide(self) -> bool:
        """Whether it wants trials in batches."""
        ...

    def submit(self, function: Callable, *args: Any) -> Future:
        """`function(*args)` begun."""
        ...

    def restart(self) -> None:
        """New workers in place of those that died."""
        ...


class Here:
    """This process, at once; a batch of trials where it is `wide`."""

    slots = 1

    def __init__(self, wide: bool):
        self.wide = wide

    def submit(self, function: Callable, *args: Any) -> Future:
        """Done when it returns."""
        future: Future = Future()
        future.set_result(function(*args))
        return future

    def restart(self) -> None:
        """There is nothing to restart."""


class Processes:
    """Worker processes beside this one; one chunk waits for each."""

    wide = False

    def __init__(self, num: int, stack: ExitStack):
        self.num, self.slots, self._stack = num, 2 * num, stack
        self._pool = stack.enter_context(process_pool(num))

    def submit(self, function: Callable, *args: Any) -> Future:
        """Begun as soon as a process is free."""
        return self._pool.submit(function, *args)

    def restart(self) -> None:
        """All processes anew: one that died took the pool with it, and what the others do is given up."""
        self._stack.close()
        self._pool = self._stack.enter_context(process_pool(self.num))


class OnRay:
    """The workers of a Ray cluster, one core each; what a lost worker or node had begun runs again elsewhere."""

    wide = False

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
        """Begun as soon as a core is free."""
        return self._remote.remote(self._settings, function, args).future()

    def restart(self) -> None:
        """Ray does so by itself."""

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


def _in_worker(known: dict[str, Any], function: Callable, args: tuple) -> Any:
    apply_settings(known)
    return function(*args)


@contextmanager
def executor(num: int, ray: str | None, wide: bool = False) -> Iterator[Executor]:
    """`num` worker processes, or this one where it is 0, which may take a `wide` batch of trials; the cluster at the
    address `ray` where one is given."""
    with ExitStack() as stack:
        if ray is not None:
            cluster = OnRay(ray)
            stack.callback(cluster.close)
            yield cluster
        else:
            yield Processes(num, stack) if num else Here(wide)
