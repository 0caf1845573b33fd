"""Executors of background work."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from threadpoolctl import threadpool_limits

from cohdc_train.slam.config import RealtimeConfig


@contextmanager
def worker_process(config: RealtimeConfig = RealtimeConfig()) -> Iterator[Executor]:
    """Run one worker process with one thread, until the `with` block ends.

    The worker yields to its parent where there are fewer cores than work, and leaves Ctrl-C to it.

    Args:
        config: niceness of the process.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as executor:
        executor.submit(_set_up, config.worker_nice).result()
        yield executor


def _set_up(nice: int) -> None:
    """Set up the worker process."""
    # A terminal sends Ctrl-C to the whole group; the parent ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # With NumPy's: the limit only reaches libraries that are loaded.
    import scipy.linalg  # noqa: F401

    threadpool_limits(1, "blas")
    if hasattr(os, "nice"):
        os.nice(nice)


class SynchronousExecutor(Executor):
    """Executor that runs a job when it is submitted, so that results do not depend on time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a job. Returns a finished future."""
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future
