"""`farhand info` on recordings of a simulated run."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from experiments.simulation import Simulation
from farhand.__main__ import app
from site_runtime.session import load_session
from site_runtime.supervisor import State
from telemetry.piece import Piece
from telemetry.recording import RecordingSource, RecordingWriter
from telemetry.row_ring import SiteEvent
from telemetry.rows import RowArray

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
WALL_OFFSET_NS = 1_764_000_000_000_000_000  # the clock of the run was zero at 16:00:00 UTC


def info(*arguments: Path) -> Result:
    return CliRunner().invoke(app, ["info", *map(str, arguments)], env={"COLUMNS": "200"})


def words(result: Result) -> str:
    return " ".join(re.sub("[─-╿]", " ", result.output).split())


@pytest.fixture(scope="module")
def rows() -> RowArray:
    return Simulation(load_session(DEMO)).run(1.0).local


def record(folder: Path, name: str, rows: RowArray, epoch: str = "9", close: bool = True) -> Path:
    states = json.dumps({str(state.value): state.name for state in State})
    metadata = {
        "session": "demo",
        "epoch": epoch,
        "states": states,
        "farhand": "0.1.0",
        "python": "3.11.7",
    }
    path = folder / f"rows-{name}-local.mcap"
    writer = RecordingWriter(path, RecordingSource("local", 2, 2, WALL_OFFSET_NS, "", metadata))
    event = SiteEvent(int(rows["stamp_ns"][0]) + 5_000_000, "ENGAGED: both sites agree")
    writer.write(Piece(rows, (event,)))
    writer.flush()
    if close:
        writer.close()
    else:
        writer.abandon()
    return path


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
