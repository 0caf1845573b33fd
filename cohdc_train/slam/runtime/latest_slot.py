"""Handover between two threads without a queue: one slot, and the newest item wins."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestSlot(Generic[T]):
    """Slot for one item; a newer item replaces one that nobody has taken yet.

    Attributes:
        dropped: number of items that were replaced.
    """

    def __init__(self) -> None:
        """Start empty and open."""
        self._changed = threading.Condition()
        self._item: T | None = None
        self._closed = False
        self._error: Exception | None = None
        self.dropped = 0

    def put(self, item: T) -> None:
        """Put an item into the slot."""
        with self._changed:
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self) -> T | None:
        """Wait for an item and take it.

        Returns:
            None when the slot is closed and empty; an error it was closed with is raised.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            return self._pop()

    def poll(self) -> T | None:
        """Take the item if there is one, without waiting; raises the error of `close`."""
        with self._changed:
            return self._pop()

    def close(self, error: Exception | None = None) -> None:
        """Close the slot. error: raised where the next item would have been taken."""
        with self._changed:
            self._closed = True
            self._error = error
            self._changed.notify()

    def _pop(self) -> T | None:
        """Take the item, or raise the error of a closed slot."""
        item, self._item = self._item, None
        if item is None and self._error is not None:
            raise self._error
        return item
