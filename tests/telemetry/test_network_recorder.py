"""Rows off a network into files: gaps, restarts, disks that fail, recorders that are killed."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import pytest

from telemetry import network_recorder
from telemetry.network_recorder import MOST_RUNS, NetworkRecorder
from telemetry.recorded_runs import recorded_runs, recording_files
from telemetry.recording import Gap, Recording
from telemetry.rows import RowArray
from telemetry.stream import Batch

STATES = {0: "OFFLINE", 3: "ENGAGED"}
DIGEST = 2**63 + 7
DEADLINE_S = 30.0
MS = 1_000_000


def batches(rows: RowArray, site: int = 0, epoch: int = 1, size: int = 50) -> list[Batch]:
    shape = (rows["q"].shape[1], rows["position_m"].shape[1])
    return [
        Batch(site, *shape, DIGEST, epoch, rows[first : first + size])
        for first in range(0, len(rows), size)
    ]


def recorder_in(folder: Path, backlog_bytes: int = 2**26) -> NetworkRecorder:
    return NetworkRecorder(folder, "demo", "format = 1\n", STATES, backlog_bytes)


def offer(recorder: NetworkRecorder, several: Iterable[Batch]) -> None:
    for batch in several:
        recorder.offer(batch, time.monotonic_ns())


def runs_in(folder: Path) -> Mapping[str, Recording]:
    runs = recorded_runs(recording_files([folder]))
    assert len({run.metadata["site"] for run in runs}) == len(runs)
    return {run.metadata["site"]: run for run in runs}


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_both_sites_are_recorded_bit_by_bit_with_what_is_known_of_them(tmp_path: Path, run) -> None:
    recorder = recorder_in(tmp_path)
    offer(recorder, batches(run.local[:1230], 0))
    offer(recorder, batches(run.remote[:900], 1, epoch=2))
    told = recorder.close()
    assert [(r.site, r.epoch, r.rows, r.gaps) for r in told] == [
        ("local", 1, 1230, ()),
        ("remote", 2, 900, ()),
    ]
    assert recorder.notices() == []
    runs = runs_in(tmp_path)
    for site, rows in (("local", run.local[:1230]), ("remote", run.remote[:900])):
        assert runs[site].rows.tobytes() == rows.tobytes()
        assert runs[site].complete
        assert runs[site].session_text == "format = 1\n"
        told_of = runs[site].metadata
        assert told_of["source"] == "network"
        assert told_of["session"] == "demo"
        assert told_of["digest"] == f"{DIGEST:016x}"
        assert told_of["states"] == '{"0": "OFFLINE", "3": "ENGAGED"}'
        assert {"farhand", "python", "layout_version"} <= told_of.keys()


def test_wall_times_are_this_machine_s_by_the_fastest_batches(tmp_path: Path, run) -> None:
    recorder = recorder_in(tmp_path)
    began_ns = time.time_ns()
    now_ns = time.monotonic_ns()
    for number, batch in enumerate(batches(run.remote[:500], 1)):
        jitter_ns = 0 if number == 3 else 40 * MS
        newest_ns = int(batch.rows["time_ns"][-1])
        recorder.offer(batch, now_ns + newest_ns + 5 * MS + jitter_ns)
    recorder.close()
    times_ns = runs_in(tmp_path)["remote"].wall_times_ns
    assert times_ns[0] == pytest.approx(began_ns + 5 * MS, abs=20 * MS)


def test_rows_that_did_not_come_are_counted_and_located_at_once(tmp_path: Path, run) -> None:
    recorder = recorder_in(tmp_path)
    several = batches(run.local[2000:4000])
    offer(recorder, several[:20])
    offer(recorder, several[23:24])
    told: list[str] = []
    until(lambda: told.extend(recorder.notices()) or told)
    assert told == ["local: 150 rows lost from row 3000 on"]
    offer(recorder, several[25:])
    [recorded] = recorder.close()
    assert recorder.notices() == ["local: 50 rows lost from row 3200 on"]
    assert recorded.gaps == (Gap(3000, 150), Gap(3200, 50))  # and none before the first that came
    back = runs_in(tmp_path)["local"]
    assert back.gaps == recorded.gaps
    assert [event.text for event in back.events] == [
        "recorder: 150 rows lost from row 3000 on",
        "recorder: 50 rows lost from row 3200 on",
    ]
    assert back.events[0].stamp_ns == run.local["stamp_ns"][3150]


def test_what_comes_twice_or_late_is_in_the_file_once(tmp_path: Path, run) -> None:
    recorder = recorder_in(tmp_path)
    several = batches(run.local[:600])
    offer(recorder, [*several[:4], several[3], several[1], *several[4:]])
    [recorded] = recorder.close()
    assert recorded.gaps == ()
    assert runs_in(tmp_path)["local"].rows.tobytes() == run.local[:600].tobytes()


def test_a_site_that_was_started_again_has_a_recording_a_run(tmp_path: Path, run) -> None:
    recorder = recorder_in(tmp_path)
    offer(recorder, batches(run.local[:500], epoch=1))
    offer(recorder, batches(run.local[:400], epoch=2))
    assert [(r.epoch, r.rows, r.gaps) for r in recorder.close()] == [(1, 500, ()), (2, 400, ())]
    runs = recorded_runs(recording_files([tmp_path]))
    assert sorted((r.metadata["epoch"], len(r.rows)) for r in runs) == [("1", 500), ("2", 400)]


def test_no_more_runs_than_a_session_has_are_begun(tmp_path: Path, run) -> None:
    recorder = recorder_in(tmp_path)
    for epoch in range(3 * MOST_RUNS):
        offer(recorder, batches(run.local[:50], epoch=epoch))
    assert len(recorder.close()) == MOST_RUNS


def test_a_minute_fills_a_file(tmp_path: Path, run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_recorder, "SEGMENT_S", 0.3)
    recorder = recorder_in(tmp_path)
    for batch in batches(run.local[:1000]):
        offer(recorder, [batch])
        time.sleep(0.05)
    recorder.close()
    assert len(recording_files([tmp_path])) > 1
    back = runs_in(tmp_path)["local"]
    assert back.complete
    assert back.rows.tobytes() == run.local[:1000].tobytes()


def test_a_folder_that_goes_is_told_and_what_came_meanwhile_is_kept(tmp_path: Path, run) -> None:
    folder = tmp_path / "out"
    recorder = recorder_in(folder)
    several = batches(run.local)
    offer(recorder, several[:20])
    until(lambda: recording_files([tmp_path]) if any(tmp_path.rglob("*.mcap")) else False)
    shutil.rmtree(folder)
    folder.write_text("a file where the folder was")
    offer(recorder, several[20:40])
    told: list[str] = []
    until(lambda: told.extend(recorder.notices()) or told)
    assert "local: cannot write" in told[0]
    folder.unlink()
    offer(recorder, several[40:60])
    until(lambda: any(tmp_path.rglob("*.mcap")))
    [recorded] = recorder.close()
    assert recorded.unwritten == 0
    assert recorder.notices()[0] == "local: recording again"
    back = runs_in(folder)["local"]
    assert back.rows["sequence"][-1] == 2999
    assert back.gaps == ()


def test_a_disk_that_fails_to_the_end_drops_the_oldest_and_counts(
    tmp_path: Path, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_recorder, "LAST_TRIES_S", 0.1)
    (tmp_path / "out").write_text("no folder")
    room = 20 * run.local[:50].nbytes
    recorder = recorder_in(tmp_path / "out", backlog_bytes=room)
    began_s = time.monotonic()
    offer(recorder, batches(run.local))
    assert time.monotonic() - began_s < 5.0  # 12 000 rows: offering waits for nothing
    [recorded] = recorder.close()
    assert recorded.rows == 0
    assert recorded.unwritten == 12_000
    assert "out" in recorded.error


KILLED = """
import sys, time
from pathlib import Path
import numpy as np
from telemetry.network_recorder import NetworkRecorder
from telemetry.stream import Batch
rows = np.load(sys.argv[2])
recorder = NetworkRecorder(Path(sys.argv[1]), "demo", "", {})
for first in range(0, len(rows), 50):
    recorder.offer(Batch(0, 2, 2, 1, 1, rows[first : first + 50]), time.monotonic_ns())
    print(first, flush=True)
    time.sleep(0.02)
"""


def test_a_killed_recorder_leaves_what_it_had_to_the_last_tenth(tmp_path: Path, run) -> None:
    np.save(tmp_path / "rows.npy", run.local)
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, tmp_path / "out", tmp_path / "rows.npy"],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
        env=os.environ | {"PYTHONPATH": "."},
    )
    assert process.stdout is not None
    offered = 0
    for line in process.stdout:
        offered = int(line)
        if offered >= 3000:
            break
    process.send_signal(signal.SIGKILL)
    process.communicate()
    back = runs_in(tmp_path / "out")["local"]
    assert not back.complete
    assert back.gaps == ()
    assert back.rows.tobytes() == run.local[: len(back.rows)].tobytes()
    assert len(back.rows) > 1500  # generous: on a loaded machine the writer waits for its turn
