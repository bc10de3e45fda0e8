"""What happened at a site, in words, from its rows."""

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from telemetry.rows import NO_PEER_STATE, RowArray

IntArray = npt.NDArray[np.int64]

Level = Literal["INFO", "WARN", "ERROR"]

REPEAT_NS: Final = 1_000_000_000
"""Events of one kind come at most this often, then with what happened since."""

_STATE_LEVELS: Final[Mapping[str, Level]] = {
    "ALIGNING": "WARN",
    "HOLD": "WARN",
    "RELEASED": "WARN",
    "FAULT": "ERROR",
    "EMERGENCY_STOP": "ERROR",
}
_STOPPED: Final = ("FAULT", "EMERGENCY_STOP")
_PEER_UNFIT: Final = ("OFFLINE", *_STOPPED)
_CLUTCH_BUTTON, _CLUTCH, _EMERGENCY_STOP, _RESET, _UNLEASED = 1, 2, 4, 8, 16
_STANDSTILL_NS: Final = 20_000_000
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

    `state_names` names the states, `cut_names` the bits of `cut` by their mask. A change of state
    is told with its cause where the rows show it.
    """

    def __init__(
        self, site_name: str, state_names: Mapping[int, str], cut_names: Mapping[int, str]
    ) -> None:
        self._site_name = site_name
        self._state_names = state_names
        self._cut_names = cut_names
        self._state: int | None = None
        self._asked = 0
        self._stamp_ns: int | None = None
        self._used = (0, 0)
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
        asked = np.concatenate(([self._asked], rows["requests"].astype(int)))
        self._state, self._asked = int(states[-1]), int(asked[-1])
        stood_ns, stale_ns = self._standstills(rows)
        events = []
        for i in np.flatnonzero(states != before):
            name = self._name(int(states[i]))
            # A site that stops or starts again does so in the tick after it was asked to.
            why = self._cause(
                name, self._name(int(before[i])), rows[i], int(asked[i] | asked[i + 1])
            )
            level = _STATE_LEVELS.get(name, "INFO")
            if name == "HOLD" and not why:
                why = _interruption(int(stood_ns[i]), int(stale_ns[i]))
            text = f"{self._site_name} is {name}" + (f": {why}" if why else "")
            events.append(Event(int(times_ns[i]), level, text))
        return events

    def _standstills(self, rows: RowArray) -> tuple[IntArray, IntArray]:
        """Return at each row the time since the row before, and of the sample in use [ns]."""
        stamps_ns, used = rows["stamp_ns"], rows["used_stamp_ns"]
        before_ns = int(stamps_ns[0]) if self._stamp_ns is None else self._stamp_ns
        used_before, since_ns = self._used if self._stamp_ns is not None else (0, before_ns)
        changed = np.diff(used, prepend=used_before) != 0
        began_ns = np.maximum.accumulate(np.where(changed, stamps_ns, since_ns))
        self._stamp_ns, self._used = int(stamps_ns[-1]), (int(used[-1]), int(began_ns[-1]))
        return np.diff(stamps_ns, prepend=before_ns), stamps_ns - began_ns

    def _name(self, state: int) -> str:
        return self._state_names.get(state, f"state {state}")

    def _cause(self, name: str, before: str, row: RowArray, asked: int) -> str:
        """Return why a site came into a state, as far as the row shows it."""
        peer = int(row["peer_state"])
        peer_name = "" if peer == NO_PEER_STATE else self._name(peer)
        if name == "RELEASED" and asked & (_CLUTCH_BUTTON | _CLUTCH):
            return "the device's clutch is open" if asked & _CLUTCH_BUTTON else "the clutch is open"
        if name == "EMERGENCY_STOP":
            if asked & _EMERGENCY_STOP:
                return "its operator stopped it"
            return "the peer is in emergency stop" if peer_name == name else ""
        if before in _STOPPED and asked & _RESET:
            return "its operator reset it"
        if name in ("HOLD", "READY") and asked & _UNLEASED:
            return "nobody here holds the lease"
        if name == "HOLD":
            return self._trouble(peer_name, row)
        return ""

    @staticmethod
    def _trouble(peer_name: str, row: RowArray) -> str:
        if peer_name in _PEER_UNFIT:
            return f"the peer is {peer_name}"
        loop_s, certified_s = float(row["loop_bound_s"]), float(row["certified_round_trip_s"])
        if loop_s > certified_s:
            return f"loop {loop_s * 1e3:.0f} ms, certified {certified_s * 1e3:.0f} ms"
        return ""

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


def _interruption(stood_ns: int, stale_ns: int) -> str:
    """Say which of loop and peer stood still for long."""
    if stood_ns > _STANDSTILL_NS:
        return f"its loop stood still for {stood_ns * 1e-6:.0f} ms"
    if stale_ns > _STANDSTILL_NS:
        return f"nothing new of the peer for {stale_ns * 1e-6:.0f} ms"
    return ""
