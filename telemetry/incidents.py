"""What was recorded around an incident, picked out while they pass by."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from telemetry.piece import NO_ARRIVALS, Piece
from telemetry.row_ring import SiteEvent
from telemetry.rows import RowArray

BEFORE_NS: Final = 5_000_000_000
AFTER_NS: Final = 1_000_000_000
DIED: Final = "died"


@dataclass(frozen=True, slots=True)
class Incident:
    """What happened at `stamp_ns` on the site's clock, with what was recorded around it."""

    why: str
    stamp_ns: int
    around: Piece


class IncidentWatch:
    """Watches one site's rows for states that are incidents, by their number and name.

    An incident within a second of another belongs to that one.
    """

    def __init__(self, states: Mapping[int, str]) -> None:
        self._states = states
        self._rows: deque[RowArray] = deque()
        self._arrivals: deque[RowArray] = deque()
        self._events: deque[SiteEvent] = deque()
        self._state: int | None = None
        self._newest_ns = 0
        self._open: tuple[int, str] | None = None

    def observe(self, piece: Piece) -> Incident | None:
        """Take note of the next rows, about a second of them at most, and what comes with them.

        Return the incident that these make complete.
        """
        rows = piece.rows
        self._events.extend(piece.events)
        if len(piece.arrivals):
            self._arrivals.append(piece.arrivals)
        if len(rows):
            self._rows.append(rows)
            self._newest_ns = int(rows["stamp_ns"][-1])
            if self._open is None:
                self._open = self._entered(rows)
            self._state = int(rows["state"][-1])
        finished = None
        if self._open is not None and self._newest_ns >= self._open[0] + AFTER_NS:
            finished = self._incident(*self._open)
            self._open = None
        self._forget()
        return finished

    def end(self, *, died: bool) -> list[Incident]:
        """Return what is left to be kept of a site that has ended."""
        incidents = [] if self._open is None else [self._incident(*self._open)]
        if died and self._rows:
            incidents.append(self._incident(self._newest_ns, DIED))
        return incidents

    def _entered(self, rows: RowArray) -> tuple[int, str] | None:
        states = rows["state"].astype(int)
        before = np.concatenate(([-1 if self._state is None else self._state], states[:-1]))
        for i in np.flatnonzero(states != before):
            name = self._states.get(int(states[i]))
            if name is not None:
                return int(rows["stamp_ns"][i]), name.lower()
        return None

    def _incident(self, stamp_ns: int, why: str) -> Incident:
        first_ns, last_ns = stamp_ns - BEFORE_NS, stamp_ns + AFTER_NS
        rows = np.concatenate(self._rows)
        within = (rows["stamp_ns"] >= first_ns) & (rows["stamp_ns"] <= last_ns)
        # An event that tells of the end may be later than every row.
        events = tuple(event for event in self._events if event.stamp_ns >= first_ns)
        rows = rows[within]
        arrivals = np.concatenate((NO_ARRIVALS, *self._arrivals))
        taken = (arrivals["row"] >= rows["sequence"][0]) & (arrivals["row"] <= rows["sequence"][-1])
        return Incident(why, stamp_ns, Piece(rows, events, arrivals[taken]))

    def _forget(self) -> None:
        start_ns = (self._newest_ns if self._open is None else self._open[0]) - BEFORE_NS
        while self._rows and self._rows[0]["stamp_ns"][-1] < start_ns:
            self._rows.popleft()
        first = self._rows[0]["sequence"][0] if self._rows else 0
        while self._arrivals and self._arrivals[0]["row"][-1] < first:
            self._arrivals.popleft()
        while self._events and self._events[0].stamp_ns < start_ns:
            self._events.popleft()
