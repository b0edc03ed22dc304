"""Where trials run: in this process, in a pool of single-threaded processes, or on a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context
from typing import Any

from tiptrace.errors import ConfigError, MissingExtraError

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_CONNECT_S = 15.0
_WORKERS_S = 300.0  # a SLURM queue may take its time; whoever waits longer starts the workers first

OpenExecutor = Callable[[], Executor]


class SerialExecutor(Executor):
    """Runs each task at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run and return a finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            future.set_exception(error)
        return future


def local_executor(workers: int) -> OpenExecutor:
    """Opens a pool of ``workers`` processes, each with one thread; one worker is this process itself."""
    if workers <= 1:
        return SerialExecutor

    def open_pool() -> Executor:
        for name in _ONE_THREAD:  # read by the libraries when a spawned worker loads them
            os.environ.setdefault(name, "1")
        return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_single_threaded)

    return open_pool


@contextmanager
def dask_executor(address: str, workers_s: float = _WORKERS_S) -> Iterator[OpenExecutor]:
    """A Dask cluster behind the same interface; the cluster runs tasks of a dead worker again by itself.

    Args:
        address: Of the scheduler.
        workers_s: How long to wait for the first worker, s.

    Raises:
        MissingExtraError: ``distributed`` is not installed.
        ConfigError: no scheduler answers at the address, or it has no worker.
    """
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise MissingExtraError("distributed", "cluster") from None
    try:
        client = distributed.Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"no Dask scheduler answers at '{address}' ({type(error).__name__}); start one with `dask scheduler` or "
            "leave --scheduler out to use this machine"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=workers_s)
        except TimeoutError:
            raise ConfigError(
                f"the Dask scheduler at '{address}' had no worker for {workers_s:g} s; start some with "
                f"`dask worker {address} --nthreads 1`"
            ) from None
        client.run(_single_threaded)
        yield lambda: client.get_executor(pure=False, retries=2)


def _single_threaded() -> None:
    import cv2

    cv2.setNumThreads(1)
