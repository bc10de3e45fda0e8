"""A look at something every so often, from a thread of its own."""

import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Keeper(ABC):
    """Calls `look` every `period_s` in a `with` statement, the first time after one period."""

    def __init__(self, name: str, period_s: float) -> None:
        self._period_s = period_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join(timeout=1.0)

    @abstractmethod
    def look(self) -> None:
        """See to what is kept."""

    def _watch(self) -> None:
        while not self._ended.wait(self._period_s):
            self.look()
