"""Two loops of one rate, whose ticks meet each other's packets at some phase."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from site_runtime.tick_phase import TickPhase

FloatArray = npt.NDArray[np.float64]

PERIOD = 1_000_000
OTHER_CLOCK = -123_456_789_000


@dataclass
class Ticks:
    """When the ticks came, and how long packets waited for one [ns]."""

    starts_ns: list[float] = field(default_factory=list)
    waits_ns: list[float] = field(default_factory=list)


def run(ways_ns: FloatArray, first_tick_ns: float, *, drift: float = 0.0, every: int = 1) -> Ticks:
    """Tick, on a clock fast by `drift`, while packets stamped every so many periods come."""
    stamps_ns = np.arange(len(ways_ns)) * float(every * PERIOD)
    order = np.argsort(stamps_ns + ways_ns)
    stamps, arrivals = stamps_ns[order].tolist(), (stamps_ns + ways_ns)[order].tolist()
    phase, ticks, taken, start_ns = TickPhase(PERIOD), Ticks(), 0, first_tick_ns
    for _ in range(every * len(ways_ns)):
        ticks.starts_ns.append(start_ns)
        seen = None
        while taken < len(arrivals) and arrivals[taken] <= start_ns:
            ticks.waits_ns.append(start_ns - arrivals[taken])
            way_ns = round(start_ns - stamps[taken]) + OTHER_CLOCK
            seen = way_ns if seen is None else max(seen, way_ns)
            taken += 1
        start_ns += (PERIOD + phase.step(seen)) * (1.0 + drift)
    return ticks


def ways(count: int, jitter_ns: float, seed: int = 1) -> FloatArray:
    """0.3 ms and, one in a while, a few times `jitter_ns` more."""
    late: FloatArray = np.random.default_rng(seed).gamma(2.0, jitter_ns / 2.0, count)
    return 300_000.0 + late


@given(st.floats(0.0, PERIOD), st.floats(-1e-4, 1e-4), st.floats(0.0, 60e3), st.integers(0, 99))
def test_whatever_the_phase_at_the_start_packets_soon_hardly_wait(
    first_ns: float, drift: float, jitter_ns: float, seed: int
) -> None:
    ticks = run(ways(5000, jitter_ns, seed), first_ns, drift=drift)
    settled = np.array(ticks.waits_ns[2000:])
    assert np.median(settled) < 40_000 + 3.0 * jitter_ns
    assert np.mean(settled > PERIOD / 2) < 0.1, "too many just miss their tick"


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_it_follows_clocks_that_drift_apart_for_long(drift: float) -> None:
    ticks = run(ways(40_000, 20e3), 0.0, drift=drift)
    assert np.median(ticks.waits_ns[-5000:]) < 100_000


def test_it_works_for_a_peer_that_sends_less_often() -> None:
    ticks = run(ways(3000, 20e3), 0.0, every=4)
    assert np.median(ticks.waits_ns[-1000:]) < 100_000


@pytest.mark.parametrize("step_ns", [-700_000, -300_000, 300_000, 700_000])
def test_a_path_that_becomes_longer_or_shorter_is_met_anew(step_ns: float) -> None:
    path_ns = ways(12_000, 20e3) + 1e6
    path_ns[3000:] += step_ns
    ticks = run(path_ns, 0.0)
    assert np.median(ticks.waits_ns[2000:3000]) < 100_000
    assert np.median(ticks.waits_ns[-2000:]) < 100_000


@pytest.mark.parametrize("seed", range(3))
def test_where_packets_come_at_random_the_rate_stays_what_it_is(seed: int) -> None:
    ticks = run(np.random.default_rng(seed).uniform(30e6, 70e6, 60_000), 0.0)
    elapsed_ns = ticks.starts_ns[-1] - ticks.starts_ns[0]
    assert abs(elapsed_ns - (len(ticks.starts_ns) - 1) * PERIOD) <= PERIOD + 1.001e-4 * elapsed_ns


def test_a_silent_peer_moves_nothing() -> None:
    phase = TickPhase(PERIOD)
    assert {phase.step(None) for _ in range(1000)} == {0}


@given(st.lists(st.none() | st.integers(-(2**63), 2**63), min_size=1, max_size=300))
def test_a_tick_never_moves_by_more_than_a_fiftieth_of_a_period(seen: list[int | None]) -> None:
    phase = TickPhase(PERIOD)
    for way_ns in seen:
        assert -PERIOD // 1000 - PERIOD // 10_000 <= phase.step(way_ns) <= PERIOD // 50
