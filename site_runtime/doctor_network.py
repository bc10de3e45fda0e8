"""The bare round trip to the other machine, where a doctor answers: no site is asked anything.

Both poll, every 0.2 ms, so that up to 0.4 ms of what they measure is their own.
"""

import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from channel.link import Link
from site_runtime.doctor_findings import Finding, Verdict

_POLL_S = 2e-4
_EVERY_S = 0.01
_PRESENT_S = 3.0
_LAST_S = 1.0  # for answers still on their way
_LONG = 160  # bytes, no less than a packet between sites
_STAMP = struct.Struct(f"<q{_LONG - 8}x")
_ROOMY_SHARE = 0.7


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Round trips [s] of what came back, (n,), and how many were sent."""

    trips_s: tuple[float, ...]
    sent: int


def doctor_keys(session_name: str) -> tuple[str, str]:
    """Keys of the one who asks and the one who answers."""
    return f"farhand/{session_name}/doctor/asks", f"farhand/{session_name}/doctor/answers"


def answer(link: Link, should_stop: Callable[[], bool]) -> int:
    """Send back whatever comes until told to stop; return how much that was."""
    answered = 0
    while not should_stop():
        for data in link.receive():
            answered += link.send(data)
        time.sleep(_POLL_S)
    return answered


def measure_round_trips(link: Link, seconds: float) -> RoundTrips | None:
    """Ask 100 times a second; None if nobody is there to answer."""
    end_s = time.monotonic() + _PRESENT_S
    while not link.peer_present():
        if time.monotonic() > end_s:
            return None
        time.sleep(0.02)
    trips_s: list[float] = []
    asks, asked = max(1, round(seconds / _EVERY_S)), 0
    start_s = time.monotonic()
    while (now_s := time.monotonic()) < start_s + seconds + _LAST_S and len(trips_s) < asks:
        if asked < asks and now_s >= start_s + asked * _EVERY_S:
            asked += 1
            link.send(_STAMP.pack(time.monotonic_ns()))
        for data in link.receive():
            if len(data) == _STAMP.size:
                trips_s.append((time.monotonic_ns() - _STAMP.unpack(data)[0]) * 1e-9)
        time.sleep(_POLL_S)
    return RoundTrips(tuple(trips_s), asked)


def round_trip_finding(
    trips: RoundTrips | None, endpoint: str, certified_s: float, period_ns: int
) -> Finding:
    """Judge a round trip against the one that the gains are proven for.

    Sites see each other's samples a tick later each: two periods are added.
    """
    what = "round trip"
    if trips is None or not trips.trips_s:
        told = f"nobody answers at {endpoint}"
        change = "on the other machine: farhand doctor SESSION.toml --answer, no site running there"
        return Finding(what, Verdict.NOT_MEASURED, told, change)
    p50, p99, worst = (float(np.percentile(trips.trips_s, p)) for p in (50, 99, 100))
    lost = 1.0 - len(trips.trips_s) / trips.sent
    told = (
        f"p50 {p50 * 1e3:.1f}, p99 {p99 * 1e3:.1f}, worst {worst * 1e3:.1f} ms, {lost:.1%} lost, "
        f"by {endpoint}; certified are {certified_s * 1e3:.0f} ms"
    )
    loop_s = worst + 2e-9 * period_ns
    if loop_s <= _ROOMY_SHARE * certified_s and lost < 0.01:
        return Finding(what, Verdict.GOOD, told)
    change = "farhand design SESSION.toml finds gains for a longer round trip; or a better network"
    return Finding(
        what, Verdict.WILL_DO if loop_s <= certified_s else Verdict.NOT_GOOD, told, change
    )
