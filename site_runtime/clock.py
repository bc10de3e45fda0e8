"""Clocks: one steady, for the daemons; one turned by hand, for simulation and tests."""

import time
from typing import Protocol

import numpy as np
import numpy.typing as npt


class Clock(Protocol):
    """Monotonic time in nanoseconds, and a way to wait for an absolute deadline."""

    def now_ns(self) -> int:
        """Return the present time [ns]."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after `deadline_ns`; at once if it has passed."""
        ...


class SteadyClock:
    """The operating system's monotonic clock; no jumps when the wall clock is set."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC [ns]."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep to an absolute deadline [ns]."""
        remaining_ns = deadline_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)


class ManualClock:
    """Time that moves only when told to: simulation and tests run the site's own code on it."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the time last set [ns]."""
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Move to `deadline_ns`; time never runs backwards."""
        self._now_ns = max(self._now_ns, deadline_ns)


class Pacer:
    """Absolute deadlines start + k·T. A tick that cannot be met is skipped and counted.

    Never catches up in a burst. A deadline that is over by more than half a period when the tick
    before it ends is skipped too: a loop that cannot keep its rate then still leaves the processor
    to the network, and is not throttled as a runaway by the scheduler.
    """

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self._deadline_ns = clock.now_ns()
        self.missed = 0

    def wait(self) -> int:
        """Sleep to the next deadline; return how late the wake-up is [ns], skips included."""
        self._deadline_ns += self._period_ns
        due_ns = self._deadline_ns
        overdue_ns = self._clock.now_ns() - due_ns - self._period_ns // 2
        if overdue_ns > 0:
            self._skip(-(-overdue_ns // self._period_ns))
        self._clock.sleep_until_ns(self._deadline_ns)
        now_ns = self._clock.now_ns()
        self._skip((now_ns - self._deadline_ns) // self._period_ns)
        return now_ns - due_ns

    def shift(self, by_ns: int) -> None:
        """Let all deadlines to come be so much later [ns]; negative: earlier."""
        self._deadline_ns += by_ns

    def _skip(self, ticks: int) -> None:
        self.missed += ticks
        self._deadline_ns += ticks * self._period_ns


class LatenessHistogram:
    """Wake-up lateness, counted in microsecond bins; percentiles without keeping every value."""

    BINS = 100_000

    def __init__(self) -> None:
        self._counts: npt.NDArray[np.int64] = np.zeros(self.BINS, dtype=np.int64)

    def add(self, lateness_ns: int) -> None:
        """Count one wake-up [ns]; the last bin takes everything above 0.1 s."""
        bin_us = lateness_ns // 1000
        self._counts[0 if bin_us < 0 else min(bin_us, self.BINS - 1)] += 1

    def percentiles_us(self, *percents: float) -> tuple[float, ...]:
        """Return the percentiles asked for [µs]; NaN when nothing has been counted."""
        cumulative = np.cumsum(self._counts)
        total = int(cumulative[-1])
        if total == 0:
            return tuple(float("nan") for _ in percents)
        return tuple(float(np.searchsorted(cumulative, total * p / 100.0)) for p in percents)
