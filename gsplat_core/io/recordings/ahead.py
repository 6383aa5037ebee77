"""Read-ahead: a thread produces the next items of an iterator while the current one is processed."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Generator
from typing import Generic, TypeVar

T = TypeVar("T")
ITEMS_AHEAD = 2


def read_ahead(items: Generator[T, None, None], name: str, ahead: int = ITEMS_AHEAD) -> Generator[T, None, None]:
    """Yield the items in order, produced by a thread at most `ahead` items in advance.

    An exception of the iterator is raised here after the preceding items. Closing this generator
    stops the thread and joins it; the iterator is closed in that thread. The thread is a daemon, so
    a blocked disk does not prevent the program from ending.

    Args:
        items: generator to run in the thread.
        name: thread name.
        ahead: maximum number of items produced but not yet consumed.
    """
    made = _Made[T](ahead)
    thread = threading.Thread(target=made.fill, args=(items,), name=name, daemon=True)
    thread.start()
    try:
        yield from made.taken()
    finally:
        made.stop()
        # The garbage collector may close the generator in any thread, also in the producing one.
        if thread is not threading.current_thread():
            thread.join()


class _Made(Generic[T]):
    """Bounded queue between the thread that produces items and the consumer."""

    def __init__(self, ahead: int) -> None:
        self._ahead = ahead
        self._changed = threading.Condition()
        self._items: deque[T] = deque()
        self._stopped = self._done = False
        self._error: BaseException | None = None

    def fill(self, items: Generator[T, None, None]) -> None:
        """Produce the items in the background thread until the iterator ends or `stop` is called."""
        error: BaseException | None = None
        try:
            try:
                while self._wait_for_room():
                    self._put(next(items))
            except StopIteration:
                pass
            finally:
                items.close()
        except BaseException as raised:  # noqa: BLE001 - carried to the thread that takes the items
            error = raised
        with self._changed:
            self._done, self._error = True, error
            self._changed.notify_all()

    def taken(self) -> Generator[T, None, None]:
        """Yield the items in the consumer's thread."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._done)
                if not self._items:
                    break
                item = self._items.popleft()
                self._changed.notify_all()
            yield item
        error, self._error = self._error, None
        if error is not None:
            raise error

    def stop(self) -> None:
        """Stop the producing thread after its current item."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _wait_for_room(self) -> bool:
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or len(self._items) < self._ahead)
            return not self._stopped

    def _put(self, item: T) -> None:
        with self._changed:
            self._items.append(item)
            self._changed.notify_all()
