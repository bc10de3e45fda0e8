"""What a link test's packets say: round trip, one-way times, loss, order, age of the loop."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from channel.clock_offset import ClockOffset
from channel.packet import Packet
from site_runtime.link_test import Phase, Report

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Spread:
    """A distribution in a few numbers [s]; NaN of nothing."""

    p50_s: float
    p90_s: float
    p99_s: float
    most_s: float

    @classmethod
    def of(cls, values_s: FloatArray) -> "Spread":
        """Return that of some values (n,) [s]."""
        if not len(values_s):
            return cls(*[float("nan")] * 4)
        p50_s, p90_s, p99_s = np.percentile(values_s, (50, 90, 99)).tolist()
        return cls(p50_s, p90_s, p99_s, float(values_s.max()))


@dataclass(frozen=True, slots=True)
class Passage:
    """One direction: packets sent, and the shares of them lost, overtaken and doubled.

    `time` is how long they took [s]; by a clock offset that is known to ± `uncertainty_s`.
    """

    sent: int
    lost: float
    reordered: float
    duplicated: float
    time: Spread
    uncertainty_s: float


@dataclass(frozen=True, slots=True)
class Figures:
    """One rate.

    `loop` is the age of the loop at ticks, `bound` what a site holds against the certified round
    trip, `covered` the share of ticks at which that is within the certified one. `jitter_s` is
    p99 − p50 of the network's round trip, `silence_s` the longest time between two arrivals here.
    """

    rate_hz: int
    round_trip: Spread
    jitter_s: float
    to_remote: Passage
    to_local: Passage
    loop: Spread
    bound: Spread
    covered: float
    silence_s: float


@dataclass(frozen=True, slots=True)
class Trace:
    """One direction's delay, packet by packet: time [s] from the phase's start, delay [s]."""

    time_s: FloatArray
    delay_s: FloatArray

    def write(self, path: Path) -> None:
        """Write it as `[channel]` takes it for `delay = { model = "trace" }`."""
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("time_s", "delay_s"))
            for time_s, delay_s in zip(self.time_s, self.delay_s, strict=True):
                writer.writerow((f"{time_s:.6f}", f"{delay_s:.6f}"))


@dataclass(frozen=True, slots=True)
class _Exchange:
    """A packet of the peer's whose echo is mine; times [ns], the offset as known when it came."""

    arrival_ns: int
    packet: Packet
    offset_ns: int
    uncertainty_ns: int

    @property
    def to_local_ns(self) -> int:
        return self.arrival_ns - self.packet.stamp_ns - self.offset_ns

    @property
    def to_remote_ns(self) -> int:
        return self.packet.echo_arrival_ns + self.offset_ns - self.packet.echo_stamp_ns


def figures(phase: Phase, certified_s: float) -> Figures:
    """Return what a phase says, against the round trip [s] that a session is certified for."""
    exchanges = list(_exchanges(phase))
    trips_s = _seconds([one.to_local_ns + one.to_remote_ns for one in exchanges])
    trip = Spread.of(trips_s)
    bound_s = _seconds([bound_ns for bound_ns in phase.ticks.bound_ns if bound_ns >= 0])
    ticks = len(phase.ticks.bound_ns)
    arrivals_s = np.unique(_seconds([arrival_ns for arrival_ns, _ in phase.arrived]))
    uncertainty_s = exchanges[-1].uncertainty_ns * 1e-9 if exchanges else float("nan")
    return Figures(
        phase.rate_hz,
        trip,
        trip.p99_s - trip.p50_s,
        _to_remote(phase, Spread.of(_trace(_heard_first(exchanges), phase).delay_s), uncertainty_s),
        _to_local(
            phase, Spread.of(_seconds([one.to_local_ns for one in exchanges])), uncertainty_s
        ),
        Spread.of(_seconds([trip_ns for trip_ns in phase.ticks.loop_ns if trip_ns >= 0])),
        Spread.of(bound_s),
        float(np.count_nonzero(bound_s <= certified_s)) / ticks if ticks else float("nan"),
        float(np.diff(arrivals_s).max(initial=0.0)),
    )


def traces(phase: Phase) -> tuple[Trace, Trace]:
    """Return the delays to the remote site and to the local one, for replay."""
    exchanges = list(_exchanges(phase))
    there = _trace(_heard_first(exchanges), phase)
    back = _trace([(one.arrival_ns, one.to_local_ns) for one in exchanges], phase)
    return there, back


def _exchanges(phase: Phase) -> Iterator[_Exchange]:
    """Go through the packets in the order of arrival; the clock offset as known by then."""
    clocks = ClockOffset()
    for arrival_ns, packet in (*phase.before, *phase.arrived):
        clocks.update(packet.echo_stamp_ns, packet.echo_arrival_ns, packet.stamp_ns, arrival_ns)
        known = clocks.estimate(arrival_ns)
        if known is not None and arrival_ns >= phase.first_ns:
            yield _Exchange(arrival_ns, packet, known.offset_ns, known.uncertainty_ns)


def _heard_first(exchanges: list[_Exchange]) -> list[tuple[int, int]]:
    """Return (arrival there on my clock, time to there) [ns], once for each packet echoed."""
    seen: dict[int, tuple[int, int]] = {}
    for one in exchanges:
        arrival_ns = one.packet.echo_arrival_ns + one.offset_ns
        seen.setdefault(one.packet.echo_stamp_ns, (arrival_ns, one.to_remote_ns))
    return list(seen.values())


def _trace(timed: list[tuple[int, int]], phase: Phase) -> Trace:
    """Return one row a moment, in order: the last of those that came at the same one."""
    rows = dict(sorted(timed))
    times_ns = np.array(list(rows), dtype=np.int64)
    # an offset off by its uncertainty may make a fast passage negative
    delays_s = np.maximum(_seconds(list(rows.values())), 0.0)
    return Trace(_seconds((times_ns - phase.first_ns).tolist()), delays_s)


def _to_local(phase: Phase, time: Spread, uncertainty_s: float) -> Passage:
    """Count by the sequence numbers that came."""
    numbers = np.array([packet.sequence for _, packet in phase.arrived], dtype=np.int64)
    sent = int(numbers.max() - numbers.min()) + 1
    _, places = np.unique(numbers, return_index=True)
    order = numbers[np.sort(places)]  # of those that came, each once
    reordered = int(np.count_nonzero(order[1:] < np.maximum.accumulate(order)[:-1]))
    return Passage(
        sent,
        (sent - len(order)) / sent,
        reordered / sent,
        (len(numbers) - len(order)) / sent,
        time,
        uncertainty_s,
    )


def _to_remote(phase: Phase, time: Spread, uncertainty_s: float) -> Passage:
    """Count by what the other end told in its first and its last packet."""
    first, last = (Report.of(phase.arrived[place][1]) for place in (0, -1))
    received, skipped, overtaken, doubled = (
        round(getattr(last, name) - getattr(first, name))
        for name in ("received", "lost", "out_of_order", "duplicates")
    )
    sent = max(1, received + skipped)
    return Passage(
        sent,
        max(0, skipped - overtaken) / sent,
        overtaken / sent,
        doubled / sent,
        time,
        uncertainty_s,
    )


def _seconds(times_ns: list[int]) -> FloatArray:
    seconds: FloatArray = np.array(times_ns, dtype=np.float64) * 1e-9
    return seconds
