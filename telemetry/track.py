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


class Track:
    """Rows that came in batches, with times on the observer's clock; the last five seconds stay."""

    def __init__(self, joints: int, dimension: int) -> None:
        self.times_ns: IntArray = np.empty(0, np.int64)
        self.rows: RowArray = np.empty(0, row_dtype(joints, dimension))
        self._clock = SiteClock()
        self._epoch: int | None = None
        self._waiting: list[RowArray] = []
        self._taken = 0

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest row [ns]; None before the first."""
        return int(self.times_ns[-1]) if len(self.times_ns) else None

    def add(self, batch: Batch, arrival_ns: int) -> None:
        """Take one batch; its rows are placed by the next `merge`."""
        if batch.epoch != self._epoch:
            self._epoch = batch.epoch
            self.merge(settled_only=False)
            self._clock.restart()
        self._clock.observe(int(batch.rows["stamp_ns"][-1]), arrival_ns)
        self._waiting.append(batch.rows)

    def merge(self, *, settled_only: bool) -> None:
        """Place the waiting rows on the timeline; optionally only once the clock has settled."""
        if not self._waiting or (settled_only and not self._clock.settled):
            return
        rows = np.concatenate(self._waiting)
        self._waiting.clear()
        self.times_ns = np.concatenate((self.times_ns, self._clock.times_ns(rows["stamp_ns"])))
        self.rows = np.concatenate((self.rows, rows))

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
            self.times_ns, self.rows = self.times_ns[old:], self.rows[old:]
            self._taken -= old

    def index_at(self, times_ns: IntArray) -> npt.NDArray[np.intp]:
        """Row in force at each time; −1 before the first."""
        return np.searchsorted(self.times_ns, times_ns, side="right") - 1

    def position_at(self, times_ns: IntArray) -> FloatArray:
        """Position (r, z) [m] between the rows; NaN outside of them."""
        return np.column_stack(
            [
                np.interp(times_ns, self.times_ns, axis_m, left=np.nan, right=np.nan)
                for axis_m in self.rows["position_m"].T
            ]
        )
