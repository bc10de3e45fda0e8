"""Sites with clocks of their own on one timeline."""

from collections import deque
from typing import Final

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]

SETTLE_BATCHES: Final = 5
WINDOW_NS: Final = 60_000_000_000
STEP_NS: Final = 1_000_000


class SiteClock:
    """Maps one site's stamps to the observer's clock, by the batches that came fastest.

    The offset is the least (arrival − newest stamp) of the last 60 s, so it holds the fastest
    passage and none of the jitter. It moves only by more than 1 ms: enough to follow two drifting
    clocks, and still between steps.
    """

    def __init__(self) -> None:
        self._heard = 0
        self._offset_ns = 0
        self._last_ns: int | None = None
        # Arrivals with rising offsets: the first is the least of the window.
        self._candidates: deque[tuple[int, int]] = deque()

    def restart(self) -> None:
        """Learn the offset anew: the site was started again, maybe on another machine."""
        self._heard = 0
        self._candidates.clear()

    @property
    def settled(self) -> bool:
        """Whether enough batches came for the offset to be worth using."""
        return self._heard >= SETTLE_BATCHES

    @property
    def offset_ns(self) -> int:
        """What put on a stamp gives the observer's clock [ns], as known now."""
        return self._offset_ns

    def observe(self, newest_stamp_ns: int, arrival_ns: int) -> None:
        """Take note of one batch: its newest stamp [ns, site] and its arrival [ns, observer]."""
        offset_ns = arrival_ns - newest_stamp_ns
        while self._candidates and self._candidates[-1][1] >= offset_ns:
            self._candidates.pop()
        self._candidates.append((arrival_ns, offset_ns))
        while self._candidates[0][0] < arrival_ns - WINDOW_NS:
            self._candidates.popleft()
        least_ns = self._candidates[0][1]
        if not self.settled or abs(least_ns - self._offset_ns) > STEP_NS:
            self._offset_ns = least_ns
        self._heard += 1

    def times_ns(self, stamps_ns: IntArray) -> IntArray:
        """Stamps (r,) on the observer's clock [ns]; strictly increasing over all calls."""
        times = stamps_ns + self._offset_ns
        if self._last_ns is not None:
            times = np.maximum(times, self._last_ns + 1)
        # At least 1 ns apart: a step back of the offset crowds a few rows, and loses none.
        places = np.arange(len(times))
        times = np.maximum.accumulate(times - places) + places
        if len(times):
            self._last_ns = int(times[-1])
        return times
