"""What happened at a site, in words, from its rows."""

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from telemetry.rows import RowArray

IntArray = npt.NDArray[np.int64]

Level = Literal["INFO", "WARN", "ERROR"]

REPEAT_NS: Final = 1_000_000_000
"""Events of one kind come at most this often, then with what happened since."""

_STATE_LEVELS: Final[Mapping[str, Level]] = {"HOLD": "WARN", "FAULT": "ERROR"}
_COUNTERS: Final = (
    ("missed", "missed {} ticks"),
    ("rejected", "rejected {} packets"),
    ("lost", "lost {} packets of its peer"),
    ("late", "got {} packets too late"),
)


class Event(NamedTuple):
    """One line of the event log."""

    time_ns: int
    level: Level
    text: str


class EventLog:
    """Derives events from consecutive rows of one site: state changes, counters, guard cuts.

    `state_names` names the states, `cut_names` the bits of `cut` by their mask.
    """

    def __init__(
        self, site_name: str, state_names: Mapping[int, str], cut_names: Mapping[int, str]
    ) -> None:
        self._site_name = site_name
        self._state_names = state_names
        self._cut_names = cut_names
        self._state: int | None = None
        self._counted: dict[str, int] = {}
        self._reported_ns: dict[str, int] = {}
        self._cut_mask = 0
        self._cut_ticks = 0

    def observe(self, times_ns: IntArray, rows: RowArray) -> list[Event]:
        """Events of these rows (r,) at these times (r,) [ns]; the first rows set the baseline."""
        if not len(rows):
            return []
        return self._state_changes(times_ns, rows) + self._counts(times_ns, rows)

    def _state_changes(self, times_ns: IntArray, rows: RowArray) -> list[Event]:
        states = rows["state"].astype(int)
        before = np.concatenate(([-1 if self._state is None else self._state], states[:-1]))
        self._state = int(states[-1])
        events = []
        for i in np.flatnonzero(states != before):
            name = self._state_names.get(int(states[i]), f"state {states[i]}")
            level = _STATE_LEVELS.get(name, "INFO")
            events.append(Event(int(times_ns[i]), level, f"{self._site_name} is {name}"))
        return events

    def _counts(self, times_ns: IntArray, rows: RowArray) -> list[Event]:
        now_ns = int(times_ns[-1])
        events = []
        for field, text in _COUNTERS:
            count = int(rows[field][-1].sum())
            more = count - self._counted.setdefault(field, int(rows[field][0].sum()))
            if more and self._due(field, now_ns):
                self._counted[field] = count
                # A counter that falls was set to zero by a restart: nothing to tell.
                if more > 0:
                    events.append(Event(now_ns, "WARN", f"{self._site_name} {text.format(more)}"))
        cuts = rows["cut"]
        self._cut_mask |= int(np.bitwise_or.reduce(cuts))
        self._cut_ticks += int(np.count_nonzero(cuts))
        if self._cut_ticks and self._due("cut", now_ns):
            limits = ", ".join(
                self._cut_names.get(1 << bit, f"bit {bit}")
                for bit in range(16)
                if self._cut_mask & 1 << bit
            )
            events.append(
                Event(
                    now_ns,
                    "WARN",
                    f"{self._site_name} guard applied its limit on {limits} "
                    f"in {self._cut_ticks} ticks",
                )
            )
            self._cut_mask = self._cut_ticks = 0
        return events

    def _due(self, kind: str, now_ns: int) -> bool:
        last_ns = self._reported_ns.get(kind)
        if last_ns is not None and now_ns - last_ns < REPEAT_NS:
            return False
        self._reported_ns[kind] = now_ns
        return True
