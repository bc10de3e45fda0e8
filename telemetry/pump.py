"""A queue that forgets rather than waits, between a producer and a consumer that may stall."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

from telemetry.rows import TelemetryError

T = TypeVar("T")

PERIOD_S: Final = 0.05
"""The least time from one call of the consumer to the next."""
CAPACITY: Final = 800


class Pump(Generic[T]):
    """Hands offered items to `consume` at once, but at most twenty times a second, on one thread.

    `consume` gets the items since its last call (in the last one maybe none) and whether it is the
    last call. It may block for as long as it likes: the oldest items are then dropped and counted.
    """

    def __init__(
        self, name: str, consume: Callable[[list[T], bool], None], capacity: int = CAPACITY
    ) -> None:
        self._consume = consume
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._lock = threading.Lock()
        self._dropped = 0
        self._busy_since: float | None = None
        self._offered = threading.Event()
        self._closing = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Items dropped so far because the consumer was not fast enough."""
        return self._dropped

    @property
    def waiting(self) -> int:
        """Items offered that the consumer has not been given yet."""
        return len(self._items)

    def stalled_s(self) -> float:
        """Time the consumer has been in its present call [s]; zero between calls."""
        since = self._busy_since
        return 0.0 if since is None else time.monotonic() - since

    def offer(self, item: T) -> None:
        """Queue one item; never blocks. TelemetryError if the consumer failed."""
        if self._error is not None:
            raise TelemetryError(f"{self._thread.name} stopped: {self._error}") from self._error
        with self._lock:
            if len(self._items) == self._capacity:
                self._items.popleft()
                self._dropped += 1
            self._items.append(item)
        self._offered.set()

    def close(self, timeout_s: float) -> bool:
        """Let the consumer finish what is queued; False if it did not within the time."""
        self._closing.set()
        self._offered.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _take(self) -> list[T]:
        with self._lock:
            items = list(self._items)
            self._items.clear()
        return items

    def _run(self) -> None:
        try:
            closing, next_s = False, time.monotonic()
            while not closing:
                self._offered.wait()
                closing = self._closing.wait(max(0.0, next_s - time.monotonic()))
                self._offered.clear()
                self._busy_since = time.monotonic()
                next_s = self._busy_since + PERIOD_S
                self._consume(self._take(), closing)
                self._busy_since = None
        except Exception as error:
            # Kept for the producer, who is told at its next offer.
            self._error = error
