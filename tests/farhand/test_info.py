"""`farhand info` on recordings of a simulated run."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from experiments.simulation import Simulation
from farhand.__main__ import app
from site_runtime.session import load_session
from telemetry.row_ring import SiteEvent
from telemetry.rows import RowArray
from tests.fakes import recordings
from tests.fakes.exchange import HOLD_TICKS, OFFSET_NS, exchange

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"


def info(*arguments: Path) -> Result:
    return CliRunner().invoke(app, ["info", *map(str, arguments)], env={"COLUMNS": "200"})


def words(result: Result) -> str:
    return " ".join(re.sub("[─-╿]", " ", result.output).split())


@pytest.fixture(scope="module")
def rows() -> RowArray:
    return Simulation(load_session(DEMO)).run(1.0).local


def record(folder: Path, name: str, rows: RowArray, epoch: int = 9, close: bool = True) -> Path:
    event = SiteEvent(int(rows["stamp_ns"][0]) + 5_000_000, "ENGAGED: both sites agree")
    path = folder / f"rows-{name}-local.mcap"
    session = load_session(DEMO)
    return recordings.record(path, "local", rows, session, epoch=epoch, events=[event], close=close)


def test_a_run_is_told_with_its_figures(tmp_path: Path, rows: RowArray) -> None:
    told = words(info(record(tmp_path, "a", rows)))
    assert "local site of demo, run 9" in told
    assert "recorded 2025-11-24 16:00:00 UTC, 1.000 s" in told
    assert f"rows {len(rows)}, 1000.0 a second; no gap" in told
    assert "cut off" not in told
    assert "ENGAGED 100.0%; 0 changes" in told
    age_ms = np.percentile(1e3 * rows["loop_bound_s"], (50, 99, 99.9, 100))
    assert f"p50 {age_ms[0]:.0f} · p99 {age_ms[1]:.0f}" in told
    assert "certified 298 ms; beyond it in 0.0% of the ticks" in told
    assert "0.005 s ENGAGED: both sites agree" in told


def test_segments_of_a_run_are_joined_and_what_is_missing_is_located(
    tmp_path: Path, rows: RowArray
) -> None:
    record(tmp_path, "a", rows[:300])
    record(tmp_path, "b", rows[310:], close=False)
    first = int(rows["sequence"][300])
    told = words(info(tmp_path))
    assert told.count("local site of demo") == 1
    assert f"{len(rows) - 10}," in told
    assert f"1 gaps: 10 from row {first} on; the file was cut off" in told


def test_each_run_has_its_own_table(tmp_path: Path, rows: RowArray) -> None:
    record(tmp_path, "a", rows, "9")
    record(tmp_path, "b", rows, "10")
    told = words(info(tmp_path))
    assert "run 9" in told
    assert "run 10" in told


def test_what_was_cut_and_what_was_beyond_is_counted(tmp_path: Path, rows: RowArray) -> None:
    worse = rows.copy()
    worse["cut"][:7] = 3
    worse["loop_bound_s"][: len(rows) // 2] = 1.0
    worse["round_trip_s"] = np.nan
    told = words(info(record(tmp_path, "a", worse)))
    assert "torque in 7 ticks, velocity in 7 ticks" in told
    assert re.search(r"beyond it in (49|50)\.\d% of the ticks", told)
    assert "round trip none ms" in told


def test_what_is_no_recording_is_told(tmp_path: Path) -> None:
    assert info(tmp_path).exit_code == 2
    other = tmp_path / "notes.mcap"
    other.write_text("no recording")
    result = info(other)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_of_both_sites_the_way_from_device_to_device_is_told_stage_by_stage(
    tmp_path: Path,
) -> None:
    local, remote = exchange()
    session, wall_ns = load_session(DEMO), recordings.WALL_OFFSET_NS
    for site, rows, offset_ns in (("local", local, OFFSET_NS), ("remote", remote, 0)):
        path = tmp_path / f"rows-a-{site}.mcap"
        recordings.record(path, site, rows, session, wall_offset_ns=wall_ns + offset_ns)
    told = words(info(tmp_path))
    assert "local → remote: 200 samples, network ± 5 µs" in told
    assert "network 1160" in told
    assert f"hold {HOLD_TICKS * 1000}" in told
    assert "remote → local:" not in told


def test_refused_packets_are_told_by_reason(tmp_path: Path, rows: RowArray) -> None:
    rows["rejected"][-1, 4], rows["rejected"][-1, 9] = 3, 1
    assert "4 rejected (3 checksum, 1 duplicate)" in words(info(record(tmp_path, "a", rows)))
