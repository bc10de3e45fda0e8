"""From the reading of one site's device to the writing of the other's, beside bare Zenoh."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from experiments.benchmarks.figures import Benchmark, Effort, Goal, Row, Spread
from experiments.benchmarks.round_trip import round_trips_ns
from experiments.benchmarks.sites import NO_DELAY, Sites
from site_runtime.keys import SiteId
from telemetry.latency import STAGES, sample_latencies
from telemetry.rows import RowArray

_HALF_PERIOD_US = 500.0
_MOST_TURNS = 10
_SETTLE_S = 1.5  # until the remote site ticks right after the local one's packets


def measure(effort: Effort) -> Iterator[Row]:
    """Run the sites, then the round trip, in turns, each from another phase of the two loops."""
    ways, trips = [], []
    turns = min(2 * effort.turns, _MOST_TURNS) if effort.turns > 1 else 1
    for _ in range(turns):
        with Sites("bench-hand-to-hand", NO_DELAY) as sites:
            sites.until_engaged()
            sites.hear(_SETTLE_S)
            rows = sites.hear(effort.seconds / turns)
        ways += [latencies(rows[site], rows[site.peer]) for site in SiteId]
        trips.append(round_trips_ns(effort.seconds / turns))
    found = np.concatenate(ways)
    ours = Spread.of(hand_to_hand_us(found))
    one_way_us = np.concatenate(trips) * 0.5e-3
    yardstick = Spread.of(one_way_us + _HALF_PERIOD_US)
    stages = ", ".join(f"{name} {np.median(found[name]) * 1e-3:.0f}" for name in STAGES)
    starts = [np.median(hand_to_hand_us(way)) for way in ways]
    yield Row(
        what="hand to hand at 1 kHz: one device read → the other written, nothing injected",
        against="half a round trip of bare Zenoh between two idle processes, and half a period",
        unit="µs",
        ours=ours,
        yardstick=yardstick,
        goals=(Goal("p50", ours.over(yardstick)[0], 1.3, 1.1),),
        notes=(
            f"medians of the stages [µs]: {stages}; the network's holds the wait for the next tick",
            f"by start and direction the median is {min(starts):.0f} to {max(starts):.0f} µs, of "
            f"{len(ways)}; half a round trip p50 {np.median(one_way_us):.0f} µs",
        ),
    )


def latencies(sender: RowArray, receiver: RowArray) -> npt.NDArray[np.void]:
    """Return `sample_latencies` of rows whose stamps are of one clock, as on one machine."""
    receiver = receiver.copy()
    receiver["clock_offset_ns"] = 0
    return sample_latencies(sender, receiver)


def hand_to_hand_us(found: npt.NDArray[np.void]) -> npt.NDArray[np.float64]:
    """Return how long samples took from their device, once read, to the other's, written [µs]."""
    took: npt.NDArray[np.float64] = (found["total"] - found["read"]) * 1e-3
    return took


HAND_TO_HAND = Benchmark("hand-to-hand", "one device read to the other written", measure)
