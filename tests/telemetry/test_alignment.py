from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.alignment import SETTLE_BATCHES, STEP_NS, WINDOW_NS, SiteClock

MS = 1_000_000


def settle(clock: SiteClock, offset_ns: int, start_ns: int = 0) -> int:
    """Batches every 50 ms with this offset; returns the next stamp."""
    for batch in range(SETTLE_BATCHES):
        assert not clock.settled or start_ns
        stamp_ns = start_ns + batch * 50 * MS
        clock.observe(stamp_ns, stamp_ns + offset_ns)
    assert clock.settled
    return start_ns + SETTLE_BATCHES * 50 * MS


def test_the_fastest_passage_counts_and_jitter_does_not() -> None:
    clock = SiteClock()
    jitter_ns = [9 * MS, 3 * MS, 7 * MS, 0, 5 * MS]
    for batch, late_ns in enumerate(jitter_ns):
        clock.observe(batch * 50 * MS, batch * 50 * MS + 1000 * MS + late_ns)
    stamps_ns = np.arange(50) * MS
    assert np.array_equal(clock.times_ns(stamps_ns), stamps_ns + 1000 * MS)
    clock.observe(300 * MS, 300 * MS + 1000 * MS + 20 * MS)
    later_ns = stamps_ns + 250 * MS
    assert np.array_equal(clock.times_ns(later_ns), later_ns + 1000 * MS)


def test_two_clocks_with_different_readings_meet() -> None:
    true_ns = np.arange(0, 1000, 50) * MS
    times_ns = []
    for reading_ns in (5_000_000 * MS, -17 * MS):
        clock = SiteClock()
        for now_ns in true_ns.tolist():
            clock.observe(now_ns + reading_ns, now_ns)
        times_ns.append(clock.times_ns(true_ns + reading_ns))
    assert np.array_equal(*times_ns)


def test_a_step_below_the_threshold_is_ignored_and_one_above_is_followed() -> None:
    for step_ns, followed in ((STEP_NS, False), (STEP_NS + 1, True)):
        clock = SiteClock()
        stamp_ns = settle(clock, 1000 * MS)
        clock.observe(stamp_ns, stamp_ns + 1000 * MS - step_ns)
        [time_ns] = clock.times_ns(np.array([stamp_ns]))
        assert time_ns == stamp_ns + 1000 * MS - (step_ns if followed else 0)


def test_a_drifting_clock_is_followed_once_the_window_has_passed() -> None:
    clock = SiteClock()
    stamp_ns = settle(clock, 1000 * MS)
    for second in range(WINDOW_NS // 10**9 + 2):
        now_ns = stamp_ns + second * 10**9
        clock.observe(now_ns, now_ns + 1005 * MS)
    [time_ns] = clock.times_ns(np.array([now_ns]))
    assert time_ns == now_ns + 1005 * MS


def test_a_restart_learns_the_offset_anew_and_time_does_not_go_back() -> None:
    clock = SiteClock()
    settle(clock, 1000 * MS)
    [before_ns] = clock.times_ns(np.array([200 * MS]))
    clock.restart()
    assert not clock.settled
    clock.observe(5 * MS, 1300 * MS)
    assert clock.times_ns(np.array([5 * MS])).tolist() == [1300 * MS]
    clock.restart()
    clock.observe(9 * MS, before_ns)
    assert clock.times_ns(np.array([9 * MS])).tolist() == [1300 * MS + 1]


@settings(deadline=None)
@given(
    batches=st.lists(
        st.tuples(st.integers(0, 10**9), st.lists(st.integers(0, 10**9), max_size=5)), max_size=12
    )
)
def test_times_increase_strictly_whatever_arrives(batches: list[tuple[int, list[int]]]) -> None:
    clock = SiteClock()
    times_ns: list[int] = []
    arrival_ns = 0
    for wait_ns, stamps_ns in batches:
        arrival_ns += wait_ns
        clock.observe(max(stamps_ns, default=0), arrival_ns)
        times_ns += clock.times_ns(np.array(stamps_ns, np.int64)).tolist()
    assert all(a < b for a, b in pairwise(times_ns))
