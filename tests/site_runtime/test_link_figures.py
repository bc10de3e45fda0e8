"""Figures of a link test, from packets whose times, losses and order are known."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from channel.delay import TraceDelay
from channel.packet import Packet
from site_runtime.link_figures import figures, traces
from site_runtime.link_test import Phase, Report, Ticks

MS = 1_000_000
CLOCK_NS = 5_000_000 * MS  # the peer's clock is ahead of mine by this
THERE_NS, BACK_NS = 40 * MS, 60 * MS
ZERO = np.zeros(2)


def packet(sequence: int, stamp_ns: int, echo_ns: int, report: Report) -> Packet:
    """A packet sent at `stamp_ns` on my clock that echoes mine of `echo_ns`."""
    told = np.array([getattr(report, name) for name in Report.__slots__])
    return Packet(
        site=1, state=0, session=1, epoch=2, sequence=sequence, stamp_ns=stamp_ns + CLOCK_NS,
        echo_epoch=1, echo_stamp_ns=echo_ns, echo_arrival_ns=echo_ns + THERE_NS + CLOCK_NS,
        used_stamp_ns=echo_ns, greatest_age_ns=0,
        position_m=told[:2], velocity_m_s=told[2:4], force_n=told[4:],
    )  # fmt: skip


def arrivals(count: int, period_ns: int = 4 * MS) -> Iterator[tuple[int, Packet]]:
    for number in range(count):
        stamp_ns = number * period_ns
        report = Report(250, number, 8 * number, 2 * number, number, 0)
        sample = packet(number, stamp_ns, stamp_ns - THERE_NS - MS, report)
        yield stamp_ns + BACK_NS, sample


def phase(arrived: list[tuple[int, Packet]], bound_ms: tuple[int, ...] = (100,)) -> Phase:
    ticks = Ticks([120 * MS] * len(bound_ms), [ms * MS for ms in bound_ms])
    return Phase(250, arrived[0][0], arrived[-1][0], arrived, [], ticks)


def test_times_are_told_each_way_within_the_uncertainty() -> None:
    seen = figures(phase(list(arrivals(200))), certified_s=0.3)
    assert seen.round_trip.p50_s == pytest.approx(0.1)
    assert seen.jitter_s == pytest.approx(0.0)
    for passage, true_ns in ((seen.to_remote, THERE_NS), (seen.to_local, BACK_NS)):
        assert abs(passage.time.p50_s - true_ns * 1e-9) <= passage.uncertainty_s
        assert passage.uncertainty_s == pytest.approx(0.05, rel=0.01)
    assert seen.loop.most_s == pytest.approx(0.12)


def test_a_stall_is_in_jitter_and_silence() -> None:
    came = [
        (arrival_ns + (50 * MS if 100 <= number < 110 else 0), sample)
        for number, (arrival_ns, sample) in enumerate(arrivals(200))
    ]
    seen = figures(phase(came), certified_s=0.3)
    assert seen.jitter_s == pytest.approx(0.05)
    assert seen.round_trip.most_s == pytest.approx(0.15)
    assert seen.silence_s == pytest.approx(0.044)  # those behind were on time


def test_lost_overtaken_and_doubled_are_told_apart() -> None:
    came = list(arrivals(100))
    came[50:52] = [came[51], came[50]]  # overtaken
    came.insert(60, came[59])  # doubled
    came = [one for one in came if one[1].sequence % 10 != 5]  # lost: 10 %
    seen = figures(phase(came), certified_s=0.3)
    assert seen.to_local.sent == 100
    assert seen.to_local.lost == pytest.approx(0.10)
    assert seen.to_local.reordered == pytest.approx(0.01)
    assert seen.to_local.duplicated == pytest.approx(0.01)
    # of ten numbers the peer skipped two, one of which came late
    assert seen.to_remote.lost == pytest.approx(0.1)
    assert seen.to_remote.reordered == pytest.approx(0.1)
    assert seen.to_remote.sent == 990


def test_the_certificate_covers_the_ticks_whose_bound_is_known_and_within_it() -> None:
    assert figures(phase(list(arrivals(9)), (100, 290, 310)), 0.3).covered == pytest.approx(2 / 3)
    unknown = Phase(250, 0, 1, list(arrivals(9)), [], Ticks([-1, -1], [-1, 100 * MS]))
    assert figures(unknown, 0.3).covered == pytest.approx(0.5)


def test_a_trace_is_one_that_can_be_injected(tmp_path: Path) -> None:
    measured = phase(list(arrivals(100)))
    for trace, true_ns in zip(traces(measured), (THERE_NS, BACK_NS), strict=True):
        trace.write(tmp_path / f"{true_ns}.csv")
        delay = TraceDelay(str(tmp_path / f"{true_ns}.csv"))
        told_s = delay.at(0.2, np.random.default_rng(0))
        assert told_s == pytest.approx(true_ns * 1e-9, abs=0.011)
        assert delay.bound_s >= told_s
