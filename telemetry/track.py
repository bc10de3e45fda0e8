"""One site's rows on the timeline of an observer who sees both sites."""

from typing import Final

import numpy as np
import numpy.typing as npt

from telemetry.alignment import SiteClock
from telemetry.rows import RowArray, row_dtype
from telemetry.stream import Batch

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

HISTORY_NS: Final = 5_000_000_000
_ROOM: Final = 20_000
_MOTION: Final = ("q", "q_dot", "position_m", "velocity_m_s", "offset_m")


class Track:
    """Rows that came in batches, with times on the observer's clock; the last five seconds stay."""

    def __init__(self, joints: int, dimension: int) -> None:
        # With room to append in place: moving seconds of rows at every batch costs more than
        # drawing them.
        self._times_ns: IntArray = np.empty(_ROOM, np.int64)
        self._rows: RowArray = np.empty(_ROOM, row_dtype(joints, dimension))
        self._held = slice(0, 0)
        self._run_begins = 0
        self._clock = SiteClock()
        self._epoch: int | None = None
        self._waiting: list[RowArray] = []
        self._taken = 0

    @property
    def times_ns(self) -> IntArray:
        """Times (r,) [ns] of the rows that are held; good until the next `merge`."""
        return self._times_ns[self._held]

    @property
    def rows(self) -> RowArray:
        """Rows (r,) that are held; good until the next `merge`."""
        return self._rows[self._held]

    @property
    def run_rows(self) -> RowArray:
        """Those of them that are of the site's newest run."""
        return self.rows[self._run_begins :]

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest row [ns]; None before the first."""
        return int(self.times_ns[-1]) if len(self.times_ns) else None

    def add(self, batch: Batch, arrival_ns: int) -> None:
        """Take one batch; its rows are placed by the next `merge`."""
        if batch.epoch != self._epoch:
            self._epoch = batch.epoch
            self.merge(settled_only=False)
            self._run_begins = len(self.rows)
            self._clock.restart()
        self._clock.observe(int(batch.rows["stamp_ns"][-1]), arrival_ns)
        self._waiting.append(batch.rows)

    def merge(self, *, settled_only: bool) -> None:
        """Place the waiting rows on the timeline; optionally only once the clock has settled."""
        if not self._waiting or (settled_only and not self._clock.settled):
            return
        rows = np.concatenate(self._waiting)
        self._waiting.clear()
        self._make_room(len(rows))
        start, end = self._held.start, self._held.stop
        self._held = slice(start, end + len(rows))
        self._times_ns[end : self._held.stop] = self._clock.times_ns(rows["stamp_ns"])
        self._rows[end : self._held.stop] = rows

    def take(self, until_ns: int) -> tuple[IntArray, RowArray]:
        """Return times (r,) [ns] and rows (r,) up to this time that were not taken before."""
        end = max(self._taken, int(np.searchsorted(self.times_ns, until_ns, side="right")))
        part = slice(self._taken, end)
        self._taken = end
        return self.times_ns[part], self.rows[part]

    def forget(self) -> None:
        """Drop taken rows older than the history."""
        if (newest_ns := self.newest_ns) is not None:
            old = int(np.searchsorted(self.times_ns, newest_ns - HISTORY_NS))
            old = min(old, self._taken)
            self._held = slice(self._held.start + old, self._held.stop)
            self._taken -= old
            self._run_begins = max(0, self._run_begins - old)

    def _make_room(self, count: int) -> None:
        if self._held.stop + count <= len(self._rows):
            return
        times_ns, rows = self.times_ns, self.rows
        room = max(_ROOM, 2 * (len(rows) + count))
        self._times_ns, self._rows = np.empty(room, np.int64), np.empty(room, rows.dtype)
        self._held = slice(0, len(rows))
        self._times_ns[self._held], self._rows[self._held] = times_ns, rows

    def index_at(self, times_ns: IntArray) -> npt.NDArray[np.intp]:
        """Row in force at each time; −1 before the first."""
        return np.searchsorted(self.times_ns, times_ns, side="right") - 1

    def row_at(self, time_ns: int) -> tuple[int, RowArray] | None:
        """Row in force at a time [ns], and its own time; None before the first."""
        index = int(np.searchsorted(self.times_ns, time_ns, side="right")) - 1
        return None if index < 0 else (int(self.times_ns[index]), self.rows[index])

    def rows_at(self, times_ns: IntArray) -> RowArray:
        """Rows in force at these times (r,), none before the first; their motion in between."""
        rows = self.rows[self.index_at(times_ns)]
        for name in _MOTION:
            for axis in range(rows[name].shape[1]):
                rows[name][:, axis] = np.interp(times_ns, self.times_ns, self.rows[name][:, axis])
        return rows

    def told_at(self, times_ns: IntArray) -> FloatArray:
        """Position told to the peer (r, z) [m] between the rows; NaN outside of them."""
        told_m = self.rows["position_m"] - self.rows["offset_m"]
        return np.column_stack(
            [
                np.interp(times_ns, self.times_ns, axis_m, left=np.nan, right=np.nan)
                for axis_m in told_m.T
            ]
        )
