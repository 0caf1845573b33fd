"""An executor that does not run beside anything, so that its results do not depend on time."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any


class AtOnce(Executor):
    """Work is done when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The result."""
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future
