"""Recordings replayed, exported and drawn, by the commands as a person uses them."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest
from matplotlib.image import imread
from rerun.chunk import RrdReader
from typer.testing import CliRunner, Result

from experiments.simulation import Run, Simulation
from farhand import replay
from farhand.__main__ import app
from site_runtime.derived import derivation
from site_runtime.session import Session, load_session
from telemetry.result_file import column_names, read_result
from telemetry.row_ring import SiteEvent
from telemetry.rows import COLUMNS, DERIVED, RowArray
from telemetry.stream import Batch
from tests.fakes import recordings
from tests.fakes.recordings import WALL_OFFSET_NS, record
from tests.ports import free_port

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
SEVEN_DOF = DEMO.with_name("seven_dof.toml")
MS = 1_000_000
DEADLINE_S = 60.0
EVENTS = (SiteEvent(5 * MS, 'ENGAGED: "both, sites" agree # 1'),)


def farhand(*arguments: str | float | Path) -> Result:
    command = [str(argument) for argument in arguments]
    return CliRunner().invoke(app, command, env={"COLUMNS": "200"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, demo_run: Run, demo_session: Session) -> Path:
    """Two seconds of both sites; of the local one, 300 rows after the first 500 are missing."""
    folder = tmp_path_factory.mktemp("recordings")
    local = np.concatenate((demo_run.local[:500], demo_run.local[800:]))
    record(folder / "rows-a-local.mcap", "local", local[:600], demo_session, events=EVENTS)
    record(folder / "rows-b-local.mcap", "local", local[600:], demo_session, close=False)
    later_ns = WALL_OFFSET_NS + 2 * MS
    record(
        folder / "rows-a-remote.mcap", "remote", demo_run.remote, demo_session,
        wall_offset_ns=later_ns,
    )  # fmt: skip
    return folder


def missing(run: Run) -> list[int]:
    """The gap of the local recording: its first row, and how many."""
    return [int(run.local["sequence"][500]), 300]


@pytest.fixture(scope="module")
def local_rows(demo_run: Run) -> RowArray:
    return np.concatenate((demo_run.local[:500], demo_run.local[800:]))


# Export -----------------------------------------------------------------------------------------


def expect_columns(rows: RowArray) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    for name in COLUMNS:
        values = rows[name] if rows[name].ndim == 2 else rows[name][:, np.newaxis]
        for i, label in enumerate(column_names(name, values.shape[1])):
            yield label, values[:, i]


def test_parquet_has_a_table_a_site_with_every_row_and_what_explains_it(
    folder: Path, tmp_path: Path, demo_run: Run, local_rows: RowArray, demo_session: Session
) -> None:
    out = tmp_path / "out"
    assert farhand("export", folder, "--to", "parquet", "--out", out).exit_code == 0
    for site, rows, shift_ns in (("local", local_rows, 0), ("remote", demo_run.remote, 2 * MS)):
        table = pq.read_table(out / f"{site}.parquet")
        for label, values in expect_columns(rows):
            assert table.column(label).to_numpy().tobytes() == values.tobytes(), label
        for label, values in derivation(demo_session)(site, rows["q"]).items():
            assert table.column(label).to_numpy().tobytes() == values.tobytes(), label
        times_ns = rows["time_ns"] + shift_ns
        assert np.array_equal(table.column("time_s").to_numpy(), times_ns * 1e-9)
        wall_ns = WALL_OFFSET_NS + rows["stamp_ns"] + shift_ns
        assert np.array_equal(table.column("wall_time_ns").to_numpy(), wall_ns)
        assert table.schema.field("q_1").metadata[b"unit"] == b"rad"
        about = {k.decode(): v.decode() for k, v in table.schema.metadata.items()}
        assert about["site"] == site
        assert about["session_text"] == demo_session.text
    gaps = pq.read_schema(out / "local.parquet").metadata[b"gaps"]
    assert json.loads(gaps) == [missing(demo_run)]
    [event] = pq.read_table(out / "events.parquet").to_pylist()
    assert (event["site"], event["text"]) == ("local", EVENTS[0].text)
    first = demo_run.local[0]
    assert event["time_s"] == (EVENTS[0].stamp_ns - first["stamp_ns"] + first["time_ns"]) * 1e-9
    assert (out / "session.toml").read_text(encoding="utf-8") == demo_session.text


def test_the_page_s_join_is_the_newest_remote_row_of_then(
    folder: Path, tmp_path: Path, demo_run: Run, local_rows: RowArray
) -> None:
    assert farhand("export", folder, "--to", "parquet", "--out", tmp_path / "try-1").exit_code == 0
    page = (DEMO.parents[1] / "docs" / "tools.md").read_text(encoding="utf-8")
    [code] = [c for c in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "join_asof" in c]
    names: dict[str, Any] = {}
    exec(code.replace("try-1", str(tmp_path / "try-1")), names)  # noqa: S102 - the page's own
    joined = names["joined"].sort_by("wall_time_ns")
    ticks = (local_rows["sequence"] - local_rows["sequence"][0])[2:]
    remote_m = demo_run.remote["position_m"][ticks - 2, 0]
    assert joined.column("position_x").to_pylist() == local_rows["position_m"][:, 0].tolist()
    assert joined.column("remote_position_x").to_pylist() == [None, None, *remote_m.tolist()]


def test_csv_says_the_units_in_its_names_and_reads_back_bit_by_bit(
    folder: Path, tmp_path: Path, local_rows: RowArray
) -> None:
    out = tmp_path / "out"
    assert farhand("export", folder, "--to", "csv", "--out", out).exit_code == 0
    with (out / "local.csv").open(encoding="utf-8", newline="") as file:
        names, *lines = csv.reader(file)
    assert names[:3] == ["time_s", "wall_time_ns", "sequence"]
    assert {"q_1 [rad]", "torque_2 [N·m]", "position_y [m]", "round_trip_s", "state"} < set(names)
    assert "manipulability [m^(2z)]" in names
    assert len(lines) == len(local_rows)
    for label, values in expect_columns(local_rows):
        [place] = [i for i, name in enumerate(names) if name.split(" [")[0] == label]
        read = np.array([line[place] for line in lines], values.dtype)
        assert np.array_equal(read, values, equal_nan=values.dtype.kind == "f"), label
    [event] = pc.read_csv(out / "events.csv").to_pylist()
    assert event["text"] == EVENTS[0].text


def test_a_result_has_the_local_ticks_with_the_newest_remote_rows(
    folder: Path, tmp_path: Path, demo_run: Run, local_rows: RowArray, demo_session: Session
) -> None:
    out = tmp_path / "run.parquet"
    assert farhand("export", folder, "--to", "result", "--out", out).exit_code == 0
    result = read_result(out)
    # the remote rows are 2 ms late: the first two ticks have none
    ticks = (local_rows["sequence"] - local_rows["sequence"][0])[2:]
    local, remote = local_rows[2:], demo_run.remote[ticks - 2]
    assert np.array_equal(result.columns["local_q_1"], local["q"][:, 0])
    assert np.array_equal(result.columns["remote_q_1"], remote["q"][:, 0])
    assert np.array_equal(result.columns["remote_sequence"], remote["sequence"])
    for name, values in derivation(demo_session)("remote", remote["q"]).items():
        assert np.array_equal(result.columns[f"remote_{name}"], values)
    assert np.array_equal(result.time_s, local["time_ns"] * 1e-9)
    assert result.metadata["session"] == demo_session.text
    assert json.loads(result.metadata["local_run"])["gaps"] == json.dumps([missing(demo_run)])


def test_one_site_alone_is_exported_and_not_joined(folder: Path, tmp_path: Path) -> None:
    alone = folder / "rows-a-remote.mcap"
    assert farhand("export", alone, "--to", "parquet", "--out", tmp_path / "out").exit_code == 0
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert made == {"remote.parquet", "events.parquet", "session.toml"}
    result = farhand("export", alone, "--to", "result", "--out", tmp_path / "run.parquet")
    assert result.exit_code == 2
    assert "0 local and 1 remote runs" in result.output


def test_a_site_that_was_started_again_has_a_table_a_run(
    tmp_path: Path, demo_run: Run, demo_session: Session
) -> None:
    record(tmp_path / "in" / "rows-l.mcap", "local", demo_run.local, demo_session)
    for epoch in (1, 2):
        rows = demo_run.remote[800 * epoch : 800 * epoch + 300]
        path = tmp_path / "in" / f"rows-{epoch}.mcap"
        record(path, "remote", rows, demo_session, epoch=epoch)
    out = tmp_path / "out"
    assert farhand("export", tmp_path / "in", "--to", "parquet", "--out", out).exit_code == 0
    epochs = [
        pq.read_schema(out / f"remote-{number}.parquet").metadata[b"epoch"] for number in (1, 2)
    ]
    assert epochs == [b"1", b"2"]


def shown(path: Path) -> dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
    """Times [ns] and values of each entity of scalars in a rerun file."""
    found: dict[str, tuple[list[int], list[Any]]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static or "t" not in chunk.timeline_names:
            continue
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            times, values = found.setdefault(chunk.entity_path, ([], []))
            times += batch.column("t").cast("int64").to_pylist()
            values += batch.column("Scalars:scalars").to_pylist()
    arrays = {path: (np.array(t), np.array(v)) for path, (t, v) in found.items()}
    return {path: (t[np.argsort(t)], v[np.argsort(t)]) for path, (t, v) in arrays.items()}


def assert_shown(path: Path, local_rows: RowArray, remote_rows: RowArray) -> None:
    entities = shown(path)
    for site, rows, shift_ns in (("local", local_rows, 0), ("remote", remote_rows, 2 * MS)):
        times_ns, torque_nm = entities[f"/torque/{site}"]
        assert np.array_equal(times_ns, rows["time_ns"] + shift_ns)
        assert torque_nm.tobytes() == rows["torque_nm"].tobytes()


def test_rrd_is_the_dashboard_in_session_time(
    folder: Path, tmp_path: Path, local_rows: RowArray, demo_run: Run
) -> None:
    out = tmp_path / "a.rrd"
    assert farhand("export", folder, "--to", "rrd", "--out", out).exit_code == 0
    assert_shown(out, local_rows, demo_run.remote)


@pytest.mark.parametrize(
    ("kind", "name"), [("parquet", ""), ("csv", ""), ("result", "a.parquet"), ("rrd", "a.rrd")]
)
def test_what_is_there_is_overwritten_only_by_force(
    folder: Path, tmp_path: Path, kind: str, name: str
) -> None:
    mine = tmp_path / (name or "mine.txt")
    mine.write_text("mine")
    wish = ("export", folder, "--to", kind, "--out", tmp_path / name)
    result = farhand(*wish)
    assert result.exit_code == 2
    assert "--force" in result.output
    assert mine.read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == [mine.name]
    assert farhand(*wish, "--force").exit_code == 0
    if not name:
        assert mine.read_text() == "mine"  # nothing else of the folder is touched


@pytest.mark.parametrize("kind", ["parquet", "csv", "result", "rrd"])
def test_a_place_that_cannot_be_written_is_told(folder: Path, tmp_path: Path, kind: str) -> None:
    (tmp_path / "file").touch()
    result = farhand("export", folder, "--to", kind, "--out", tmp_path / "file" / "out")
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_a_file_and_a_folder_are_not_taken_for_each_other(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for kind, out in (("csv", tmp_path / "file"), ("rrd", tmp_path)):
        result = farhand("export", folder, "--to", kind, "--out", out, "--force")
        assert result.exit_code == 2
        assert "writes a" in result.output


# The session ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seven_dof_run() -> tuple[Session, RowArray]:
    """A session that names a URDF."""
    session = load_session(SEVEN_DOF)
    return session, Simulation(session).run(0.4).local


def to_rrd(recording: Path, *more: str | Path) -> Result:
    out = recording.with_suffix(".rrd")
    return farhand("export", recording, "--to", "rrd", "--out", out, "--force", *more)


def test_a_recording_holds_the_urdf_that_its_session_names(
    seven_dof_run: tuple[Session, RowArray], tmp_path: Path
) -> None:
    session, rows = seven_dof_run
    result = to_rrd(record(tmp_path / "rows-a-local.mcap", "local", rows, session))
    assert result.exit_code == 0
    assert "may differ" not in result.output


def test_a_urdf_that_is_not_in_it_is_found_beside_or_through_the_original(
    seven_dof_run: tuple[Session, RowArray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, rows = seven_dof_run
    monkeypatch.setattr(recordings, "named_files", lambda _: {})
    path = record(tmp_path / "rows-a-local.mcap", "local", rows, session)
    alone = to_rrd(path)
    assert alone.exit_code == 2
    assert "seven_dof_arm.urdf" in alone.output
    assert "--session" in alone.output
    assert to_rrd(path, "--session", SEVEN_DOF).exit_code == 0
    urdf = SEVEN_DOF.with_name("seven_dof_arm.urdf").read_text(encoding="utf-8")
    (tmp_path / "seven_dof_arm.urdf").write_text(urdf, encoding="utf-8")
    assert to_rrd(path).exit_code == 0
    (tmp_path / "seven_dof_arm.urdf").write_text(urdf + "\n", encoding="utf-8")
    changed = to_rrd(path)
    assert changed.exit_code == 0
    assert "may differ" in changed.output


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_tables_without_the_robot_have_what_was_recorded_and_say_what_is_left_out(
    seven_dof_run: tuple[Session, RowArray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
) -> None:
    session, rows = seven_dof_run
    monkeypatch.setattr(recordings, "named_files", lambda _: {})
    path = record(tmp_path / "rows-a-local.mcap", "local", rows, session)

    def names(out: Path, *more: str | Path) -> tuple[set[str], str]:
        result = farhand("export", path, "--to", kind, "--out", out, *more)
        assert result.exit_code == 0
        table = (pq.read_table if kind == "parquet" else pc.read_csv)(out / f"local.{kind}")
        return {name.split(" [")[0] for name in table.column_names}, result.output

    bare, told = names(tmp_path / "bare")
    assert "are left out" in told
    assert all(name in told for name in DERIVED)
    assert {label for label, _ in expect_columns(rows)} < bare
    whole, told = names(tmp_path / "whole", "--session", SEVEN_DOF)
    assert "left out" not in told
    assert whole - bare == set(DERIVED)
    wrong = ("--session", DEMO, "--out", tmp_path / "wrong")
    assert farhand("export", path, "--to", kind, *wrong).exit_code == 2


def test_another_session_is_refused(folder: Path, tmp_path: Path) -> None:
    other = ("--session", DEMO.with_name("paper_free.toml"))
    result = farhand("export", folder, "--to", "rrd", "--out", tmp_path / "a.rrd", *other)
    assert result.exit_code == 2
    assert "recorded was" in result.output


# Replay -----------------------------------------------------------------------------------------


@contextmanager
def ports() -> Iterator[tuple[str, ...]]:
    yield ("--port", str(free_port()), "--web-port", str(free_port()))


def test_a_replay_as_fast_as_it_goes_shows_every_row(
    folder: Path, tmp_path: Path, local_rows: RowArray, demo_run: Run
) -> None:
    saved = tmp_path / "a.rrd"
    with ports() as where:
        result = farhand("replay", folder, "--speed", "max", "--quit", "--save", saved, *where)
    assert result.exit_code == 0, result.output
    assert "dashboard: " in result.output
    assert "2 takes" not in result.output
    assert_shown(saved, local_rows, demo_run.remote)


class Board:
    """A dashboard that takes note; `room` says how many batches it has waiting."""

    def __init__(self) -> None:
        self.offered: list[tuple[float, Batch, int]] = []
        self.waiting_batches = 0

    def offer(self, batch: Batch, arrival_ns: int) -> None:
        self.offered.append((time.monotonic(), batch, arrival_ns))


def show(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def shown(*_: object) -> Iterator[Board]:
        yield board

    monkeypatch.setattr(replay, "shown", shown)


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Board:
    board = Board()
    show(board, monkeypatch)
    return board


@pytest.mark.parametrize(("speed", "start", "least_s"), [("2", "0", 0.9), ("0.2", "1.7", 1.2)])
def test_a_replay_takes_its_time(
    folder: Path, board: Board, speed: str, start: str, least_s: float
) -> None:
    result = farhand("replay", folder, "--speed", speed, "--start", start, "--quit")
    assert result.exit_code == 0
    offered_s = [at for at, _, _ in board.offered]
    assert least_s < offered_s[-1] - offered_s[0] < least_s + 5.0
    arrivals_ns = [arrival_ns for _, _, arrival_ns in board.offered]
    assert arrivals_ns == sorted(arrivals_ns)
    for at_s, batch, arrival_ns in board.offered:
        assert arrival_ns == batch.rows["time_ns"][-1] + 2 * MS * batch.site
        since_s = (arrival_ns - arrivals_ns[0]) * 1e-9 / float(speed)
        assert at_s - offered_s[0] >= since_s - 0.05


def test_a_replay_starts_where_it_is_told_to(folder: Path, board: Board) -> None:
    assert farhand("replay", folder, "--start", "1.5", "--speed", "0", "--quit").exit_code == 0
    for site in (0, 1):
        first = next(batch for _, batch, _ in board.offered if batch.site == site)
        assert first.rows["time_ns"][0] == (1500 - 2 * site) * MS
    result = farhand("replay", folder, "--start", "7", "--quit")
    assert result.exit_code == 2
    assert "ends at 2.00" in result.output


class StalledBoard(Board):
    """A dashboard without room, whose watcher presses Ctrl-C after having waited a while."""

    def __init__(self) -> None:
        self.asked = 0
        super().__init__()

    @property
    def waiting_batches(self) -> int:
        self.asked += 1
        if self.asked == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return replay.MOST_WAITING

    @waiting_batches.setter
    def waiting_batches(self, _: int) -> None: ...


def test_a_replay_waits_for_a_viewer_that_is_slow(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = StalledBoard()
    show(board, monkeypatch)
    assert farhand("replay", folder, "--speed", "max").exit_code == 0
    assert board.asked == 20
    assert board.offered == []


@pytest.mark.parametrize("speed", ["-1", "nan", "fast"])
def test_what_is_no_speed_is_refused(folder: Path, board: Board, speed: str) -> None:
    result = farhand("replay", folder, f"--speed={speed}", "--quit")
    assert result.exit_code == 2
    assert "is no speed" in result.output
    assert board.offered == []


def test_the_dashboard_stays_until_ctrl_c(folder: Path) -> None:
    with ports() as where:
        process = subprocess.Popen(
            [sys.executable, "-m", "farhand", "replay", folder, "--speed", "max", *where],
            stderr=subprocess.PIPE,
            text=True,
            cwd=DEMO.parents[1],
        )
        try:
            assert process.stderr is not None
            for line in process.stderr:
                if "that was all" in line:
                    break
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()
    assert process.returncode == 0, said


# Plot -------------------------------------------------------------------------------------------


def test_a_recording_and_its_result_are_drawn(folder: Path, tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    assert farhand("plot", folder, "--out", picture).exit_code == 0
    assert imread(picture).shape[:2] == (1134, 1260)
    run = tmp_path / "run.parquet"
    farhand("export", folder, "--to", "result", "--out", run)
    assert farhand("plot", run, "--out", tmp_path / "b.png").exit_code == 0
    one = ("plot", folder / "rows-a-remote.mcap", "--panel", "force", "--panel", "states")
    assert farhand(*one, "--from", "0.5", "--to", "1", "--out", tmp_path / "c.png").exit_code == 0
    assert imread(tmp_path / "c.png").shape[0] < 500


def test_what_cannot_be_drawn_is_told(folder: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "a.png")
    for wrong, told in (
        (("plot", folder, "--panel", "speed", *out), "there are states, error"),
        (("plot", folder, "--from", "7", *out), "nothing was recorded from 7"),
        (("plot", folder, "--out", tmp_path / "no" / "a.png"), "no/a.png"),
        (("plot", tmp_path / "no.parquet", *out), "no.parquet"),
        (("plot", folder, tmp_path / "no.parquet", *out), "drawn alone"),
    ):
        result = farhand(*wrong)
        assert result.exit_code == 2, wrong
        assert told in result.output
        assert "Traceback" not in result.output
    (tmp_path / "a.png").write_text("mine")
    result = farhand("plot", folder, *out)
    assert result.exit_code == 2
    assert "--force" in result.output
    assert farhand("plot", folder, *out, "--force").exit_code == 0


# What recordings may hold -----------------------------------------------------------------------

Wish = Callable[[Path], tuple[str | Path, ...]]


@pytest.mark.parametrize(
    "wish",
    [
        lambda out: ("export", "--to", "csv", "--out", out),
        lambda out: ("plot", "--out", out),
        lambda out: ("replay", "--quit"),
    ],
)
def test_empty_recordings_several_takes_and_several_sessions_are_told(
    tmp_path: Path, demo_run: Run, demo_session: Session, board: Board, wish: Wish
) -> None:
    command, *options = wish(tmp_path / "out")

    def refused(folder: Path, *more: str) -> str:
        result = farhand(command, folder, *options, *more)
        assert result.exit_code == 2
        assert "Traceback" not in result.output
        assert not (tmp_path / "out").exists()
        assert board.offered == []
        return result.output

    empty = tmp_path / "empty" / "rows-a.mcap"
    record(empty, "local", demo_run.local[:0], demo_session)
    assert "no row was recorded" in refused(empty)
    twice = tmp_path / "twice"
    for epoch in (1, 2):
        wall_offset_ns = WALL_OFFSET_NS + 10**11 * epoch
        rows = demo_run.local[: 100 * epoch]
        record(
            twice / f"rows-{epoch}.mcap", "local", rows, demo_session,
            epoch=epoch, wall_offset_ns=wall_offset_ns,
        )  # fmt: skip
    assert "2 takes" in refused(twice)
    assert "takes 1 to 2" in refused(twice, "--take", "3")
    other = load_session(DEMO.with_name("paper_free.toml"))
    record(twice / "rows-3.mcap", "remote", demo_run.remote, other)
    assert "different sessions: " in refused(twice)
    (twice / "rows-3.mcap").unlink()
    assert farhand(command, twice, *options, "--take", "2").exit_code == 0
