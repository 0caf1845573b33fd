"""Executors of background work."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from threadpoolctl import threadpool_limits

NICE = 15  # a worker gives way to tracking when there are fewer cores than work


@contextmanager
def worker_process() -> Iterator[Executor]:
    """One process of one thread, ready to work, that gives way to its parent and leaves Ctrl-C to
    it.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as executor:
        executor.submit(_begin).result()
        yield executor


def _begin() -> None:
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a terminal sends it to the whole group; the parent ends this process
    import scipy.linalg  # noqa: F401  with numpy's: the limit only reaches libraries that are loaded

    threadpool_limits(1, "blas")
    if hasattr(os, "nice"):
        os.nice(NICE)


class SynchronousExecutor(Executor):
    """Executor that works when a job is submitted, so that results do not depend on time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return a finished future."""
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future
