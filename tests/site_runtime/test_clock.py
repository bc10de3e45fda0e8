from collections.abc import Iterable, Iterator
from itertools import pairwise
from math import isnan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from site_runtime.clock import LatenessHistogram, ManualClock, Pacer, SteadyClock

START, PERIOD = 5_000_123, 1_000_000


class LateClock(ManualClock):
    """Wakes each sleeper late by the next of a list; in time when the list is used up."""

    def __init__(self, lateness_ns: Iterable[int] = ()) -> None:
        super().__init__(START)
        self._lateness_ns: Iterator[int] = iter(lateness_ns)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        super().sleep_until_ns(deadline_ns + next(self._lateness_ns, 0))


def wakes(clock: ManualClock, pacer: Pacer, count: int) -> list[tuple[float, int]]:
    """(wake-up after the start in periods, lateness returned) of the next ticks."""
    seen = []
    for _ in range(count):
        lateness_ns = pacer.wait()
        seen.append(((clock.now_ns() - START) / PERIOD, lateness_ns))
    return seen


def test_lateness_of_one_tick_does_not_move_the_next() -> None:
    clock = LateClock([300_000] * 50)
    pacer = Pacer(clock, PERIOD)
    assert wakes(clock, pacer, 50) == [(k + 0.3, 300_000) for k in range(1, 51)]
    assert pacer.missed == 0


def test_a_shift_moves_all_deadlines_to_come() -> None:
    clock = LateClock()
    pacer = Pacer(clock, PERIOD)
    pacer.wait()
    pacer.shift(PERIOD // 4)
    assert wakes(clock, pacer, 2) == [(2.25, 0), (3.25, 0)]
    pacer.shift(-PERIOD // 4)
    assert wakes(clock, pacer, 2) == [(4, 0), (5, 0)]
    assert pacer.missed == 0


def test_a_stall_is_skipped_and_counted_never_caught_up() -> None:
    clock = LateClock([0, 3_500_000, 0])
    pacer = Pacer(clock, PERIOD)
    assert wakes(clock, pacer, 4) == [(1, 0), (5.5, 3_500_000), (6, 0), (7, 0)]
    assert pacer.missed == 3


@pytest.mark.parametrize(
    ("work_ns", "next_wake", "missed"),
    [
        (PERIOD // 2, 2.0, 0),  # done in time
        (PERIOD + PERIOD // 2, 2.5, 0),  # half a period over: at once
        (PERIOD + PERIOD // 2 + 1, 3.0, 1),  # more than that: the next deadline
        (11 * PERIOD, 12.0, 10),
        (11 * PERIOD + PERIOD // 4, 12.25, 10),
    ],
)
def test_a_tick_that_overruns_is_followed_at_once_or_by_the_next_deadline(
    work_ns: int, next_wake: float, missed: int
) -> None:
    clock = LateClock()
    pacer = Pacer(clock, PERIOD)
    pacer.wait()
    clock.sleep_until_ns(START + PERIOD + work_ns)
    late_ns = round((next_wake - 2.0) * PERIOD)
    assert wakes(clock, pacer, 1) == [(next_wake, late_ns)]
    assert pacer.missed == missed
    assert wakes(clock, pacer, 1) == [(int(next_wake) + 1.0, 0)]


@pytest.mark.parametrize(("late_ns", "missed"), [(PERIOD - 1, 0), (PERIOD, 1), (2 * PERIOD, 2)])
def test_a_tick_is_missed_from_the_next_deadline_on(late_ns: int, missed: int) -> None:
    clock = LateClock([late_ns])
    pacer = Pacer(clock, PERIOD)
    pacer.wait()
    assert pacer.missed == missed
    pacer.wait()
    assert clock.now_ns() == START + (2 + missed) * PERIOD


@given(
    ticks=st.lists(
        st.tuples(st.integers(0, 4 * PERIOD), st.integers(0, 4 * PERIOD)), min_size=1, max_size=40
    )
)
def test_at_most_one_tick_a_period_and_none_unaccounted_for(ticks: list[tuple[int, int]]) -> None:
    clock = LateClock([late for late, _ in ticks])
    pacer = Pacer(clock, PERIOD)
    periods = [0]
    for _, work_ns in ticks:
        assert pacer.wait() >= 0
        periods.append((clock.now_ns() - START) // PERIOD)
        clock._now_ns += work_ns
    assert all(later > earlier for earlier, later in pairwise(periods))
    assert len(ticks) + pacer.missed == periods[-1]


def test_manual_time_never_runs_backwards() -> None:
    clock = ManualClock(7)
    clock.sleep_until_ns(9)
    clock.sleep_until_ns(8)
    assert clock.now_ns() == 9


def test_the_steady_clock_sleeps_to_the_deadline_and_never_back() -> None:
    clock = SteadyClock()
    deadline_ns = clock.now_ns() + 2_000_000
    clock.sleep_until_ns(deadline_ns)
    after_ns = clock.now_ns()
    assert after_ns >= deadline_ns
    clock.sleep_until_ns(deadline_ns - 10**12)
    assert clock.now_ns() >= after_ns


@given(
    lateness_ns=st.lists(st.integers(-2000, 200_000_000), min_size=1, max_size=300),
    percents=st.lists(st.sampled_from([1, 25, 50, 75, 90, 99, 100]), min_size=1, max_size=4),
)
def test_percentiles_are_those_of_the_microseconds_counted(
    lateness_ns: list[int], percents: list[int]
) -> None:
    histogram = LatenessHistogram()
    for value in lateness_ns:
        histogram.add(value)
    microseconds = np.clip(np.array(lateness_ns) // 1000, 0, LatenessHistogram.BINS - 1)
    expected = np.percentile(microseconds, percents, method="inverted_cdf")
    assert histogram.percentiles_us(*percents) == tuple(expected)


def test_the_thousandth_latest_wake_up_is_seen() -> None:
    histogram = LatenessHistogram()
    for _ in range(1998):
        histogram.add(5_900)
    histogram.add(70_000)
    histogram.add(80_000)
    assert histogram.percentiles_us(50, 99.9, 99.95, 100) == (5.0, 5.0, 70.0, 80.0)


def test_without_a_wake_up_there_is_no_percentile() -> None:
    assert all(isnan(value) for value in LatenessHistogram().percentiles_us(50, 100))
