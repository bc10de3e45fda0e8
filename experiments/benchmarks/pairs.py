"""More pairs of sites on one machine, each meeting by itself or all through one router."""

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.benchmarks.figures import Benchmark, Effort, Goal, Row, Spread
from experiments.benchmarks.hand_to_hand import hand_to_hand_us, latencies
from experiments.benchmarks.router import Router, routing
from experiments.benchmarks.sites import NO_DELAY, Sites
from experiments.benchmarks.usage import family, usage_of
from site_runtime.keys import SiteId
from telemetry.rows import RowArray

_RATE_HZ = 100  # so that eight pairs find room on two cores
_MOST_S = 10.0


@dataclass(frozen=True, slots=True)
class _Found:
    """What so many pairs took: processor time of each, by second [% of a core], lateness [µs].

    `beyond_us` is how much longer a sample took from hand to hand than the median of its way [µs]:
    the median itself is the phase in which the two loops happened to start.
    """

    pairs: int
    cpu_percent: npt.NDArray[np.float64]
    lateness_us: npt.NDArray[np.float64]
    beyond_us: npt.NDArray[np.float64]


def measure(effort: Effort) -> Iterator[Row]:
    """Run one pair and more of them, first directly, then through a router."""
    yield from _rows(_run(effort, None), "each meeting directly")
    yield from through_router(effort)


def through_router(effort: Effort) -> Iterator[Row]:
    """Run one pair and more of them that all meet at one router."""
    with routing() as router:
        yield from _rows(_run(effort, router), "all through one router, its time counted")


def _run(effort: Effort, router: Router | None) -> list[_Found]:
    """Start pairs beside those that run, and measure as often as `effort` asks."""
    found: list[_Found] = []
    running: list[Sites] = []
    with ExitStack() as stack:
        for pairs in effort.pairs:
            running += [
                stack.enter_context(_pair(number, router)) for number in range(len(running), pairs)
            ]
            for sites in running:
                sites.until_engaged()
            found.append(_watch(running, min(effort.seconds, _MOST_S), router))
    return found


def _pair(number: int, router: Router | None) -> Sites:
    return Sites(
        f"bench-pair-{number}",
        {"loop.rate_hz": _RATE_HZ, **NO_DELAY},
        options=("--no-record",),
        router=None if router is None else router.endpoint,
    )


def _watch(running: list[Sites], seconds: float, router: Router | None) -> _Found:
    pids = [pid for sites in running for site in SiteId for pid in family(sites.pid(site))]
    pids += [] if router is None else [router.pid]
    start_ns = time.monotonic_ns()
    used_s, at_s = [usage_of(pids).cpu_s], [time.monotonic()]
    for _ in range(max(round(seconds), 1)):
        time.sleep(1.0)
        used_s.append(usage_of(pids).cpu_s)
        at_s.append(time.monotonic())
    heard = [sites.heard_since(start_ns) for sites in running]
    return _Found(
        len(running),
        100.0 * np.diff(used_s) / np.diff(at_s) / len(running),
        np.concatenate([rows["lateness_ns"] for both in heard for rows in both.values()]) * 1e-3,
        np.concatenate([_beyond_us(both, site) for both in heard for site in SiteId]),
    )


def _beyond_us(both: Mapping[SiteId, RowArray], to: SiteId) -> npt.NDArray[np.float64]:
    took_us = hand_to_hand_us(latencies(both[to.peer], both[to]))
    return took_us - np.median(took_us)


def _rows(found: list[_Found], how: str) -> Iterator[Row]:
    one, most = found[0], found[-1]
    growth = float(np.mean(most.cpu_percent) / np.mean(one.cpu_percent))
    yield Row(
        what=f"processor time a pair, {most.pairs} pairs at {_RATE_HZ} Hz, {how}",
        against=f"that of {one.pairs}",
        unit="% of a core",
        ours=Spread.of(most.cpu_percent),
        yardstick=Spread.of(one.cpu_percent),
        goals=(Goal("linear: mean of a pair", growth, 1.2, 1.1),),
        notes=tuple(_told(each) for each in found),
    )
    for name, of_most, of_one in (
        ("wake-up lateness", most.lateness_us, one.lateness_us),
        ("hand to hand beyond its median", most.beyond_us, one.beyond_us),
    ):
        yield Row(
            what=f"{name}, {most.pairs} pairs at {_RATE_HZ} Hz, {how}",
            against=f"that of {one.pairs}",
            unit="µs",
            ours=Spread.of(of_most),
            yardstick=Spread.of(of_one),
            goals=(),
        )


def _told(found: _Found) -> str:
    late, beyond = Spread.of(found.lateness_us), Spread.of(found.beyond_us)
    return (
        f"{found.pairs}: {np.mean(found.cpu_percent):.1f} % a pair; lateness p50 {late.p50:.0f}, "
        f"p99 {late.p99:.0f}, p99.9 {late.p999:.0f} µs; hand to hand beyond its median "
        f"p99 {beyond.p99:.0f}, p99.9 {beyond.p999:.0f} µs"
    )


PAIRS = Benchmark("pairs", "pairs of sites on one machine, directly and through a router", measure)
