"""The hand-over between two threads that never queues: one slot, and the newest wins."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestSlot(Generic[T]):
    """Holds one item at most. What a newer one replaces before it was taken is dropped and counted."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._closed = False
        self._error: Exception | None = None
        self.dropped = 0

    def put(self, item: T) -> None:
        """Replace what is there."""
        with self._changed:
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self) -> T | None:
        """Wait for an item. Returns None once the slot is closed and empty; raises the error it was
        closed with.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            return self._pop()

    def poll(self) -> T | None:
        """The item if there is one, without waiting; raises the error the slot was closed with."""
        with self._changed:
            return self._pop()

    def close(self, error: Exception | None = None) -> None:
        """No item will follow; `error` is raised where the next one would have been taken."""
        with self._changed:
            self._closed, self._error = True, error
            self._changed.notify()

    def _pop(self) -> T | None:
        item, self._item = self._item, None
        if item is None and self._error is not None:
            raise self._error
        return item
