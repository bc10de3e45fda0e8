"""A look at something every so often, from a thread of its own."""

import threading
import traceback
from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import Self

from site_runtime.daemon_log import DaemonLog


class Keeper(ABC):
    """Calls `look` every `period_s` in a `with` statement, the first time after one period.

    A look that fails is no end: it is an ERROR in the log, once for each reason, what is kept goes
    to its safe side, and the next look comes all the same.
    """

    def __init__(self, name: str, period_s: float, log: DaemonLog) -> None:
        self._name = name
        self._period_s = period_s
        self._log = log
        self._failures: set[str] = set()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join(timeout=1.0)
        self.ended()

    @abstractmethod
    def look(self) -> None:
        """See to what is kept."""

    @abstractmethod
    def look_failed(self) -> None:
        """Bring what is kept to its safe side: nobody knows what it is like now."""

    def ended(self) -> None:  # noqa: B027 - most leave nothing
        """Do what is left to do once no look comes any more."""

    def _watch(self) -> None:
        while not self._ended.wait(self._period_s):
            self._look_and_go_on()

    def _look_and_go_on(self) -> None:
        for step in (self.look, self.look_failed):
            try:
                step()
            except Exception as error:
                self._report(error)
            else:
                return

    def _report(self, error: Exception) -> None:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(frame.filename).name}:{frame.lineno}"
        if place not in self._failures:  # places, of which there are so many only
            self._failures.add(place)
            self._log.say(
                f"keeping the {self._name} failed, and goes on: "
                f"{type(error).__name__}: {error} ({place})",
                "ERROR",
            )
