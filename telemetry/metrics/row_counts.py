"""What the rows of one site add up to: every row is counted, in batches of any size."""

from collections.abc import Iterable
from math import nan
from typing import Final

import numpy as np

from telemetry.metrics.histogram import Histogram
from telemetry.rows import NO_PEER_STATE, RowArray

# 1 kHz is 1 ms, 4 kHz 0.25 ms: finest around a tick's length
TICK_BOUNDS_S: Final = tuple(
    us / 1e6
    for us in (
        *(5, 10, 20, 50, 100, 150, 200, 250, 300, 400, 500, 700),
        *(1000, 1500, 2000, 5000, 10_000, 20_000, 50_000, 100_000),
    )
)
DELAY_BOUNDS_S: Final = tuple(
    ms / 1e3
    for ms in (
        *(0.2, 0.5, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70),
        *(100, 150, 200, 300, 500, 1000, 2000),
    )
)

STAGES: Final = {"read": "read_ns", "step": "step_ns", "write": "write_ns", "send": "sent_ns"}
"""The parts of a tick, and the column that tells when each was done."""

_UNKNOWN: Final = {
    "state": NO_PEER_STATE,
    "peer_state": NO_PEER_STATE,
    "loop_bound_s": nan,
    "certified_round_trip_s": nan,
    "clock_uncertainty_ns": -1,
}


class RowCounts:
    """Sums and histograms over all rows; `cut_masks` are the bits of `cut` to count."""

    def __init__(self, dtype: "np.dtype[np.void]", cut_masks: Iterable[int]) -> None:
        self._last = np.zeros(1, dtype)
        for column, value in _UNKNOWN.items():
            self._last[column] = value
        self.state_entries = np.zeros(256, np.int64)
        self.cut_ticks = dict.fromkeys(cut_masks, 0)
        self.lateness_s = Histogram(TICK_BOUNDS_S)
        self.duration_s = Histogram(TICK_BOUNDS_S)
        self.stage_s = {stage: Histogram(TICK_BOUNDS_S) for stage in STAGES}
        self.round_trip_s = Histogram(DELAY_BOUNDS_S)
        self.one_way_delay_s = Histogram(DELAY_BOUNDS_S)
        self.network_delay_s = Histogram(DELAY_BOUNDS_S)
        self.hold_s = Histogram(DELAY_BOUNDS_S)

    @property
    def last(self) -> np.void:
        """The newest row; one that knows nothing before the first."""
        row: np.void = self._last[0]
        return row

    def add(self, rows: RowArray) -> None:
        """Count the next rows, at least one."""
        before = np.concatenate((self._last, rows[:-1]))
        self._last = rows[-1:]
        states = rows["state"]
        self.state_entries += np.bincount(states[states != before["state"]], minlength=256)
        for mask in self.cut_ticks:
            self.cut_ticks[mask] += int(np.count_nonzero(rows["cut"] & mask))
        self.lateness_s.add(rows["lateness_ns"] / 1e9)
        self._add_stages(rows)
        # a row tells the duration of the tick before it, if both read their device
        timed = (rows["read_ns"] > 0) & (before["read_ns"] > 0)
        self.duration_s.add(rows["duration_ns"][timed] / 1e9)
        self.round_trip_s.add(rows["round_trip_s"])
        self.one_way_delay_s.add(rows["one_way_delay_s"])
        self._add_new_samples(rows, before)

    def _add_stages(self, rows: RowArray) -> None:
        """Each stage takes from the end of the one before it that there was in the tick."""
        begin_ns = np.zeros(len(rows))
        for stage, column in STAGES.items():
            end_ns = rows[column].astype(float)
            reached = end_ns > 0
            self.stage_s[stage].add((end_ns - begin_ns)[reached] / 1e9)
            begin_ns = np.where(reached, end_ns, begin_ns)

    def _add_new_samples(self, rows: RowArray, before: RowArray) -> None:
        """Each of the peer's samples counts once, at the tick that first used it."""
        first_used = (rows["used_stamp_ns"] != before["used_stamp_ns"]) & (
            rows["used_arrival_ns"] != 0
        )
        new = rows[first_used]
        arrival_ns = new["used_arrival_ns"]
        sent_ns = new["used_stamp_ns"] + new["clock_offset_ns"]
        known = new["clock_uncertainty_ns"] >= 0
        self.network_delay_s.add((arrival_ns - sent_ns)[known] / 1e9)
        self.hold_s.add((new["stamp_ns"] - arrival_ns) / 1e9)
