"""What the doctor measures: lateness, ticks, disk, round trips."""

import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from channel.memory_link import memory_links
from site_runtime import doctor_disk
from site_runtime.clock import LatenessHistogram, SteadyClock
from site_runtime.doctor_disk import disk_writes, free_disk
from site_runtime.doctor_findings import Verdict
from site_runtime.doctor_network import (
    RoundTrips,
    answer,
    measure_round_trips,
    round_trip_finding,
)
from site_runtime.doctor_timing import (
    Lateness,
    NotDrivenError,
    as_granted,
    lateness_finding,
    measure_lateness,
    measure_ticks,
    tick_finding,
)
from site_runtime.keys import SiteId
from site_runtime.real_time import RealTimeSettings
from site_runtime.supervisor import State

GOOD, WILL_DO, NOT_GOOD = Verdict.GOOD, Verdict.WILL_DO, Verdict.NOT_GOOD
MS = 1_000_000


@pytest.mark.parametrize("mode", ["enforce", "try", "off"])
def test_a_loop_is_measured_and_what_is_refused_told(mode: str) -> None:
    measured = measure_lateness(2 * MS, 0.1, RealTimeSettings(mode), None)  # type: ignore[arg-type]
    assert 50 <= measured.ticks < 1000
    assert 0 <= measured.missed < measured.ticks
    assert list(measured.percentiles_us) == sorted(measured.percentiles_us)
    assert mode != "off" or measured.refused == ()


def test_a_cpu_that_is_not_there_is_refused_and_measured_without() -> None:
    measured = measure_lateness(MS, 0.02, RealTimeSettings("enforce"), 4000)
    assert "CPU 4000" in measured.refused


def test_all_but_enforcing_stays_as_asked() -> None:
    assert as_granted(RealTimeSettings("enforce", 70, 1, 2)) == RealTimeSettings("try", 70, 1, 2)
    assert as_granted(RealTimeSettings("off", 70)) == RealTimeSettings("off", 70)


@pytest.mark.parametrize(
    ("percentiles_us", "missed", "verdict"),
    [
        ((20, 60, 100, 400), 0, GOOD),
        ((20, 60, 101, 400), 0, WILL_DO),
        ((20, 60, 100, 1400), 1, WILL_DO),
        ((20, 60, 100, 1400), 10, WILL_DO),
        ((20, 60, 100, 1400), 11, NOT_GOOD),
        ((20, 500, 600, 900), 0, WILL_DO),
        ((20, 501, 600, 900), 0, NOT_GOOD),
    ],
)
@pytest.mark.parametrize("decisive", [True, False])
def test_lateness_is_judged_by_the_period(
    percentiles_us: tuple[float, ...], missed: int, verdict: Verdict, decisive: bool
) -> None:
    measured = Lateness(percentiles_us, missed, 10_000, ("memory locked",))
    found = lateness_finding("lateness", measured, MS, decisive=decisive)
    assert found.verdict is verdict
    assert found.decisive is decisive
    assert f"{missed} of 10000 ticks missed, at 1000 Hz; refused: memory locked" in found.measured
    assert ("rate_hz" in found.change) is (verdict is NOT_GOOD and decisive)
    quarter = lateness_finding("lateness", measured, 4 * MS, decisive=True)
    assert (quarter.verdict is NOT_GOOD) is (missed > 10)


def took(*microseconds: int) -> LatenessHistogram:
    histogram = LatenessHistogram()
    for duration_us in microseconds:
        histogram.add(duration_us * 1000)
    return histogram


@pytest.mark.parametrize(
    ("microseconds", "verdict", "rate_hz"),
    [(500, GOOD, None), (501, WILL_DO, None), (900, WILL_DO, None), (1250, NOT_GOOD, 400)],
)
def test_ticks_are_judged_by_the_period(
    microseconds: int, verdict: Verdict, rate_hz: int | None
) -> None:
    found = tick_finding("tick", took(*[microseconds] * 100), MS)
    assert found.verdict is verdict
    assert found.decisive
    assert ("rate_hz" in found.change) is (rate_hz is not None)
    if rate_hz is not None:
        assert f"rate_hz = {rate_hz} " in found.change


class FakeSite:
    """Drives from its fifth tick on, then fails, or never drives."""

    def __init__(self, *, drives_at: int = 5, fails_at: int | None = None) -> None:
        self.identity = SiteId.LOCAL
        self.cause = SimpleNamespace(value="waiting")
        self.telemetry = SimpleNamespace(flush=lambda: None)
        self.failure: Exception | None = None
        self.ticks = 0
        self.calls: list[str] = []
        self._drives_at, self._fails_at = drives_at, fails_at

    @property
    def state(self) -> State:
        return State.ENGAGED if self.ticks >= self._drives_at else State.READY

    def open(self) -> None:
        self.calls.append("open")

    def tick(self) -> None:
        self.ticks += 1
        if self.ticks == self._fails_at:
            self.failure = ValueError("broken")

    def close(self) -> None:
        self.calls.append("close")


def test_only_ticks_that_drive_are_counted() -> None:
    sites = [FakeSite(), FakeSite(drives_at=8)]
    taken = measure_ticks(sites, SteadyClock(), MS, 0.05)  # type: ignore[arg-type]
    for site, histogram in zip(sites, taken, strict=True):
        assert histogram._counts.sum() == site.ticks - 8 > 0
        assert site.calls == ["open", "close"]


def test_sites_that_fail_or_never_drive_are_told_and_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    failing = FakeSite(fails_at=7)
    with pytest.raises(NotDrivenError, match="local site failed: broken"):
        measure_ticks([failing], SteadyClock(), MS, 1.0)  # type: ignore[list-item]
    monkeypatch.setattr("site_runtime.doctor_timing._ENGAGE_S", 0.05)
    idle = FakeSite(drives_at=10**9)
    with pytest.raises(NotDrivenError, match="did not engage: local waiting"):
        measure_ticks([idle], SteadyClock(), MS, 1.0)  # type: ignore[list-item]
    assert failing.calls == idle.calls == ["open", "close"]


# The recorder's disk.


def test_the_disk_is_measured_where_recordings_will_be_and_left_as_it_was(tmp_path: Path) -> None:
    found = disk_writes(tmp_path / "not" / "yet")
    assert found.verdict in (GOOD, WILL_DO)
    assert str(tmp_path) in found.measured
    assert list(tmp_path.iterdir()) == []
    assert not found.decisive


@pytest.mark.parametrize(
    ("worst_s", "verdict"), [(0.5, GOOD), (0.6, WILL_DO), (5.0, WILL_DO), (5.1, NOT_GOOD)]
)
def test_a_disk_is_slow_by_its_worst_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, worst_s: float, verdict: Verdict
) -> None:
    monkeypatch.setattr(doctor_disk, "_synchronised_writes", lambda _: [0.001, worst_s, 0.002])
    found = disk_writes(tmp_path)
    assert found.verdict is verdict
    assert f"in 2.0 ms, worst {worst_s * 1e3:.1f} ms" in found.measured
    assert ("[recorder]" in found.change) is (verdict is not GOOD)


def test_a_disk_that_refuses_is_not_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Path) -> list[float]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(doctor_disk, "_synchronised_writes", refuse)
    found = disk_writes(tmp_path)
    assert found.verdict is NOT_GOOD
    assert "Permission denied" in found.change


@pytest.mark.parametrize(
    ("free_gib", "verdict"), [(10.0, GOOD), (9.0, WILL_DO), (1.0, WILL_DO), (0.9, NOT_GOOD)]
)
def test_free_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_gib: float, verdict: Verdict
) -> None:
    usage = SimpleNamespace(free=int(free_gib * 2**30))
    monkeypatch.setattr(doctor_disk.shutil, "disk_usage", lambda _: usage)
    found = free_disk(tmp_path / "absent", 7200.0)
    assert found.verdict is verdict
    assert f"{free_gib:.1f} GiB free" in found.measured
    assert "last 2 h" in found.measured


# Round trips.


def test_a_round_trip_is_measured_against_one_who_answers() -> None:
    asks, answers = memory_links()
    done = threading.Event()
    told: list[int] = []
    thread = threading.Thread(target=lambda: told.append(answer(answers, done.is_set)))
    thread.start()
    try:
        measured = measure_round_trips(asks, 0.3)
    finally:
        done.set()
        thread.join()
    assert measured is not None
    assert measured.sent == 30
    assert told == [30]
    assert len(measured.trips_s) == 30
    assert all(0.0 < trip_s < 1.0 for trip_s in measured.trips_s)


def test_nobody_may_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("site_runtime.doctor_network._PRESENT_S", 0.05)
    asks, answers = memory_links()
    answers.close()
    measured = measure_round_trips(asks, 0.1)
    assert measured is None
    found = round_trip_finding(measured, "tcp/b:7447", 0.3, MS)
    assert found.verdict is Verdict.NOT_MEASURED
    assert "nobody answers at tcp/b:7447" in found.measured
    assert "--answer" in found.change


@pytest.mark.parametrize(
    ("worst_s", "lost", "verdict"),
    [
        (0.208, 0, GOOD),
        (0.209, 0, WILL_DO),
        (0.208, 1, WILL_DO),
        (0.297, 0, WILL_DO),
        (0.299, 0, NOT_GOOD),
    ],
)
def test_a_round_trip_is_judged_by_what_is_certified(
    worst_s: float, lost: int, verdict: Verdict
) -> None:
    trips = RoundTrips((0.1,) * 98 + (worst_s,), 99 + lost)
    found = round_trip_finding(trips, "tcp/b:7447", 0.3, MS)
    assert found.verdict is verdict
    assert f"worst {worst_s * 1e3:.1f} ms, {lost}.0% lost" in found.measured
    assert "certified are 300 ms" in found.measured
    assert not found.decisive
