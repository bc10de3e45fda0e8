"""Runs of both sites on one timeline."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from site_runtime.session import Session, load_session
from telemetry import takes
from telemetry.rows import RowArray, TelemetryError
from telemetry.takes import describe, joined_rows, read_take
from tests.fakes.recordings import WALL_OFFSET_NS, record

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
MS = 1_000_000
# The sites' clocks read 5 s and 91 s at the start: with these offsets both are at one wall time.
OFFSETS_NS = {"local": WALL_OFFSET_NS - 5_000 * MS, "remote": WALL_OFFSET_NS - 91_000 * MS}


@pytest.fixture(scope="module")
def session() -> Session:
    return load_session(DEMO)


@dataclass
class Writer:
    folder: Path
    session: Session

    def __call__(
        self, name: str, site: str, rows: RowArray, *, epoch: int = 9, later_ns: int = 0
    ) -> Path:
        path = self.folder / f"rows-{name}-{site}.mcap"
        offset_ns = OFFSETS_NS[site] + later_ns
        return record(path, site, rows, self.session, epoch=epoch, wall_offset_ns=offset_ns)


@pytest.fixture
def write(tmp_path: Path, session: Session) -> Writer:
    return Writer(tmp_path, session)


def test_both_sites_are_on_the_local_site_s_session_time(write: Writer, run) -> None:
    write("a", "local", run.local[:400])
    remote = run.remote[:400].copy()
    remote["time_ns"] += 777 * MS  # that daemon was started earlier; the wall clock decides
    write("a", "remote", remote, later_ns=3 * MS)
    take = read_take([write.folder])
    [local], [other] = take.of("local"), take.of("remote")
    assert np.array_equal(take.times_ns(local), run.local["time_ns"][:400])
    assert np.array_equal(take.times_ns(other), run.local["time_ns"][:400] + 3 * MS)
    assert take.span_ns == (0, 402 * MS)
    assert "2025-11-24 16:00:00 UTC, 0.4 s: local 400 rows, remote 400 rows" in describe(take)


def test_wall_clocks_that_the_sites_measured_to_disagree_do_not_part_them(
    write: Writer, run
) -> None:
    local = run.local[:400].copy()
    local["clock_uncertainty_ns"] = 2 * MS
    local["clock_offset_ns"] = (5_000 - 91_000) * MS + 300_000  # of the remote clock, 0.3 ms off
    local["clock_uncertainty_ns"][:50] = -1
    local["clock_offset_ns"][:50] = 0
    write("a", "local", local)
    # 50 ms off, more than the uncertainty; a millisecond, less
    for name, later_ns, seen_ns in (("a", 50 * MS, 300_000), ("b", 1 * MS, 1 * MS)):
        path = write(name, "remote", run.remote[:400], later_ns=later_ns)
        take = read_take([write.folder])
        [other] = take.of("remote")
        assert np.array_equal(take.times_ns(other), run.local["time_ns"][:400] + seen_ns)
        assert take.offset_ns(take.of("local")[0]) == -5_000 * MS
        path.unlink()


def test_a_site_alone_gives_its_own_time(write: Writer, run) -> None:
    take = read_take([write("a", "remote", run.remote[1000:1200])])
    assert take.span_ns == (1000 * MS, 1199 * MS)
    assert take.of("local") == ()


def test_arrivals_are_all_rows_in_batches_in_the_order_of_their_newest(write: Writer, run) -> None:
    write("a", "local", run.local[:430])
    write("a", "remote", run.remote[:410], later_ns=20 * MS)
    arrivals = read_take([write.folder]).arrivals()
    times_ns = [time_ns for _, time_ns in arrivals]
    assert times_ns == sorted(times_ns)
    for site, rows in enumerate((run.local[:430], run.remote[:410])):
        batches = [batch.rows for batch, _ in arrivals if batch.site == site]
        assert np.concatenate(batches).tobytes() == rows.tobytes()
        assert {len(batch) for batch in batches[:-1]} == {50}
    assert {batch.digest for batch, _ in arrivals} == {write.session.digest}
    assert {batch.epoch for batch, _ in arrivals} == {9}


def test_arrivals_begin_where_they_are_wanted(write: Writer, run) -> None:
    write("a", "local", run.local[:430])
    write("a", "remote", run.remote[:410], later_ns=20 * MS)
    arrivals = read_take([write.folder]).arrivals(start_ns=200 * MS)
    first = {site: next(b.rows for b, _ in arrivals if b.site == site) for site in (0, 1)}
    assert first[0]["time_ns"][0] == 200 * MS
    assert first[1]["time_ns"][0] == 180 * MS
    assert read_take([write.folder]).arrivals(start_ns=10**12) == []


def test_a_site_that_was_started_again_is_in_the_same_take(write: Writer, run) -> None:
    write("a", "local", run.local[:1000])
    write("a", "remote", run.remote[:300], epoch=1)
    again = run.remote[:200].copy()
    write("b", "remote", again, epoch=2, later_ns=600 * MS)
    take = read_take([write.folder])
    assert [r.metadata["epoch"] for r in take.of("remote")] == ["1", "2"]
    assert take.times_ns(take.of("remote")[1])[0] == 600 * MS
    assert {batch.epoch for batch, _ in take.arrivals() if batch.site == 1} == {1, 2}
    with pytest.raises(TelemetryError, match="1 local and 2 remote runs"):
        joined_rows(take)


def test_runs_apart_in_time_are_takes_to_choose_from(write: Writer, run) -> None:
    for name, epoch in (("a", 1), ("b", 2)):
        for site, rows in (("local", run.local), ("remote", run.remote)):
            write(name, site, rows[: 100 * epoch], epoch=epoch, later_ns=epoch * 60_000 * MS)
    with pytest.raises(TelemetryError, match=r"(?s)2 takes.*1: .* 0\.1 s.*2: .* 0\.2 s.*--take"):
        read_take([write.folder])
    assert [len(r.rows) for r in read_take([write.folder], 2).runs] == [200, 200]
    assert [len(r.rows) for r in read_take([write.folder], 1).runs] == [100, 100]
    for number in (0, 3, -1):
        with pytest.raises(TelemetryError, match="takes 1 to 2"):
            read_take([write.folder], number)


def test_segments_are_joined_in_whatever_order_they_are_named(write: Writer, run) -> None:
    second = write("b", "local", run.local[110:200])
    first = write("a", "local", run.local[:100])
    [joined] = read_take([second, first]).runs
    assert joined.rows["sequence"].tolist() == [*range(100), *range(110, 200)]
    assert [(gap.first, gap.rows) for gap in joined.gaps] == [(100, 10)]


def test_recordings_of_different_sessions_are_told_by_name(
    write: Writer, run, session: Session
) -> None:
    write("a", "local", run.local[:10])
    other = load_session(DEMO.with_name("paper_free.toml"))
    record(write.folder / "rows-o-remote.mcap", "remote", run.remote[:10], other)
    with pytest.raises(TelemetryError, match=f"different sessions: .*{session.digest:016x}"):
        read_take([write.folder])


def test_recordings_without_rows_are_told(write: Writer, run, tmp_path: Path) -> None:
    empty = write("a", "local", run.local[:0])
    with pytest.raises(TelemetryError, match="no row was recorded"):
        read_take([empty])
    (tmp_path / "nothing").mkdir()
    with pytest.raises(TelemetryError, match="there is no recording"):
        read_take([tmp_path / "nothing"])


def test_rows_of_another_layout_are_told_with_the_version_that_wrote_them(
    write: Writer, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write("a", "local", run.local[:10])
    newer = np.dtype([*takes.row_dtype(2, 2).descr, ("added", "<f8")])
    monkeypatch.setattr(takes, "row_dtype", lambda joints, dimension: newer)
    with pytest.raises(TelemetryError, match=r"layout version \d+.*farhand that wrote it, 0\.1\.0"):
        read_take([path])


def test_joined_each_local_tick_has_the_newest_remote_row_of_then(write: Writer, run) -> None:
    remote = np.concatenate((run.remote[:300], run.remote[500:900]))
    write("a", "local", run.local[:2000])
    write("a", "remote", remote, later_ns=10 * MS + 1)
    local, joined = joined_rows(read_take([write.folder]))
    assert len(local) == len(joined)
    # nothing in the first 11 ms, over 100 ms into the gap, over 100 ms after the end
    held = [*range(11, 410), *range(511, 1010)]
    assert local["sequence"].tolist() == held
    newest = [min(t - 11, 299) if t < 511 else min(t - 11, 899) for t in held]
    assert joined["sequence"].tolist() == newest
