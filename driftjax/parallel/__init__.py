"""Batches, worker processes, devices and compiled programs that outlive the process; imports `core` only."""

from driftjax.parallel.batch import concatenate as concatenate
from driftjax.parallel.batch import vmap_batch as vmap_batch
from driftjax.parallel.devices import DeviceExecutor as DeviceExecutor
from driftjax.parallel.executors import BatchExecutor as BatchExecutor
from driftjax.parallel.executors import CompileAheadExecutor as CompileAheadExecutor
from driftjax.parallel.executors import apply_settings as apply_settings
from driftjax.parallel.executors import num_cores as num_cores
from driftjax.parallel.executors import num_workers as num_workers
from driftjax.parallel.executors import process_executor as process_executor
from driftjax.parallel.executors import process_pool as process_pool
from driftjax.parallel.executors import settings as settings
from driftjax.parallel.executors import spare_workers as spare_workers
from driftjax.parallel.executors import thread_executor as thread_executor
from driftjax.parallel.programs import call as call
from driftjax.parallel.programs import clear_program_cache as clear_program_cache
from driftjax.parallel.programs import compile_ahead as compile_ahead
from driftjax.parallel.rendezvous import run_together as run_together
from driftjax.parallel.source import source_hash as source_hash
