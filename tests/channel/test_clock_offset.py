import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.clock_offset import ClockOffset

MS = 1_000_000
S = 1_000_000_000


@settings(deadline=None)
@given(
    offset_ns=st.integers(-(10**15), 10**15),
    drift_ppm=st.integers(-90, 90),
    base_out_ms=st.integers(0, 200),
    base_back_ms=st.integers(0, 200),
    jitter_ms=st.integers(0, 100),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_true_offset_is_always_within_the_uncertainty(
    offset_ns: int,
    drift_ppm: int,
    base_out_ms: int,
    base_back_ms: int,
    jitter_ms: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)

    def jitter_ns() -> int:
        return int(rng.exponential(jitter_ms * MS)) if jitter_ms else 0

    def true_offset_ns(now_ns: int) -> int:
        return offset_ns + now_ns * drift_ppm // 1_000_000

    clock = ClockOffset()
    shortest_ns = None
    now_ns = 0
    for _ in range(200):
        sent_ns = now_ns
        there_ns = sent_ns + base_out_ms * MS + jitter_ns()
        answered_ns = there_ns + int(rng.integers(0, 20 * MS))
        back_ns = answered_ns + base_back_ms * MS + jitter_ns()
        clock.update(
            sent_ns,
            there_ns - true_offset_ns(there_ns),
            answered_ns - true_offset_ns(answered_ns),
            back_ns,
        )
        now_ns = back_ns + int(rng.integers(0, 100 * MS))
        estimate = clock.estimate(now_ns)
        assert estimate is not None
        error_ns = abs(estimate.offset_ns - true_offset_ns(now_ns))
        assert error_ns <= estimate.uncertainty_ns + 2
        trip_ns = (there_ns - sent_ns) + (back_ns - answered_ns)
        shortest_ns = trip_ns if shortest_ns is None else min(shortest_ns, trip_ns)
        drifted_ns = 3 * (now_ns // 10_000 + 2)
        assert estimate.uncertainty_ns <= shortest_ns // 2 + drifted_ns
    assert clock.restarts == 0


def test_the_fastest_packets_each_way_need_not_be_of_one_trip() -> None:
    clock = ClockOffset()
    clock.update(0, 1 * MS, 1 * MS, 51 * MS)  # 1 ms out, 50 ms back
    clock.update(100 * MS, 150 * MS, 150 * MS, 151 * MS)  # 50 ms out, 1 ms back
    estimate = clock.estimate(151 * MS)
    assert estimate is not None
    assert estimate.uncertainty_ns < 1.1 * MS
    assert abs(estimate.offset_ns) < 0.1 * MS


def test_nothing_is_known_before_the_first_exchange() -> None:
    clock = ClockOffset()
    assert clock.offset_ns is None
    assert clock.estimate(0) is None


def test_a_fresh_bound_replaces_one_that_has_aged() -> None:
    clock = ClockOffset()
    clock.update(0, 0, 0, 0)
    hour_ns = 3600 * S
    aged = clock.estimate(hour_ns)
    assert aged is not None
    assert aged.uncertainty_ns == hour_ns // 10_000
    clock.update(hour_ns, hour_ns + MS, hour_ns + MS, hour_ns + 2 * MS)
    fresh = clock.estimate(hour_ns + 2 * MS)
    assert fresh is not None
    assert fresh.uncertainty_ns < 1.1 * MS


def test_a_clock_that_jumped_starts_the_filter_again() -> None:
    clock = ClockOffset()
    clock.update(0, 0, 0, MS)
    clock.update(S, 11 * S, 11 * S, S + MS)
    assert clock.restarts == 1
    estimate = clock.estimate(S + MS)
    assert estimate is not None
    assert abs(estimate.offset_ns + 10 * S) <= estimate.uncertainty_ns


def test_an_answer_before_its_question_is_ignored() -> None:
    clock = ClockOffset()
    clock.update(10, 0, 0, 9)
    clock.update(0, 10, 9, 20)
    assert clock.offset_ns is None


def test_reset_forgets() -> None:
    clock = ClockOffset()
    clock.update(0, 0, 0, MS)
    clock.reset()
    assert clock.offset_ns is None
