"""The recorder: here, with its disk made to fail; and as a process, killed and stopped."""

import errno
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from telemetry.backlog import Backlog, Piece
from telemetry.companion import SharedMemory
from telemetry.recorder import Recorder, RecorderOptions
from telemetry.recorder_process import RecorderProcess
from telemetry.recording import Recording, read_recording
from telemetry.row_ring import ARRIVAL, SiteEvent
from telemetry.rows import COLUMNS, TelemetryError, row_dtype
from telemetry.stream import TelemetryStream

ENGAGED, FAULT = 3, 6
STATES = {ENGAGED: "ENGAGED", FAULT: "FAULT"}
DEADLINE_S = 30.0
ROW_BYTES = row_dtype(2, 2).itemsize


def options(folder: Path, **changes: object) -> RecorderOptions:
    values = {
        "folder": str(folder),
        "keep_s": 3600.0,
        "session_name": "demo",
        "session_text": "format = 1\n",
        "session_files": {},
        "site": "local",
        "wall_offset_ns": time.time_ns() - time.monotonic_ns(),
        "states": STATES,
        "incident_states": ("FAULT", "EMERGENCY_STOP"),
    }
    return RecorderOptions(**values | changes)  # type: ignore[arg-type]


def put(stream: TelemetryStream, rows: int, state: int = ENGAGED) -> None:
    for _ in range(rows):
        stream.arrived([stream.count.to_bytes(8, "little"), b"second"])
        put_row(stream, state)


def put_row(stream: TelemetryStream, state: int = ENGAGED) -> None:
    length = {"scalar": (), "joint": (2,), "task": (2,), "reason": (12,)}
    fields = {
        name: np.full(length[column.axis], stream.count % 250)
        for name, column in COLUMNS.items()
        if name != "sequence"
    }
    stream.put(**fields | {"state": state, "stamp_ns": time.monotonic_ns()})


def until(condition: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end_s, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.005)


def recorded(folder: Path) -> Recording:
    return read_recording(*sorted(folder.glob("rows-*.mcap")))["local"]


def incidents(folder: Path) -> dict[str, Recording]:
    return {
        path.stem.rpartition("-")[2]: read_recording(path)["local"]
        for path in folder.glob("incident-*.mcap")
    }


def assert_as_put(recording: Recording) -> None:
    rows = recording.rows
    assert (rows["sequence"] % 250 == rows["q"].T).all()
    assert (rows["missed"] == rows["sequence"] % 250).all()
    arrivals = recording.arrivals
    assert np.array_equal(arrivals["row"], np.repeat(rows["sequence"], 2))
    assert np.array_equal(arrivals["number"] // 2, arrivals["row"])
    first, second = arrivals[::2], arrivals[1::2]
    assert np.array_equal(first["data"][:, :8].copy().view("<u8")[:, 0], rows["sequence"])
    assert {second["data"].tobytes()} <= {len(second) * b"second".ljust(160, b"\0")}
    assert set(first["length"]) | set(second["length"]) <= {8, 6}


class Disk:
    """Stands in for `os.write`: fails, or blocks, when told to."""

    def __init__(self) -> None:
        self.error: int | None = None
        self.stalled = False
        self._write = os.write

    def write(self, descriptor: int, data: bytes) -> int:
        while self.stalled:
            time.sleep(0.005)
        if self.error is not None:
            # A disk fills up in mid-write: here the chunk is whole, what follows it is not.
            self._write(descriptor, data[:-10])
            raise OSError(self.error, os.strerror(self.error))
        return self._write(descriptor, data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    monkeypatch.setattr("telemetry.recording.os.write", disk.write)
    monkeypatch.setattr("telemetry.recorder.RETRY_S", 0.05)
    monkeypatch.setattr("telemetry.recorder.LAST_TRIES_S", 0.2)
    return disk


@pytest.fixture
def stream() -> TelemetryStream:
    return TelemetryStream(2, 2, 0, 7, 8, lambda _: None)


def test_options_survive_the_way_to_the_recorder(tmp_path: Path) -> None:
    sent = options(tmp_path, session_text='name = "a\nb" # µ')
    assert "\n" not in sent.to_json()
    assert RecorderOptions.from_json(sent.to_json()) == sent


def test_rows_events_and_what_explains_them_are_recorded(
    tmp_path: Path, stream: TelemetryStream
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    put(stream, 2500)
    stream.event(5, "ENGAGED")
    stream.farewell(6)
    recorder.finish()
    recording = recorded(tmp_path)
    assert recording.complete
    assert recording.rows.tobytes() == stream.last(2500).tobytes()
    assert recording.events == ((5, "ENGAGED"), (6, "farewell"))
    assert recording.session_text == "format = 1\n"
    told = recording.metadata
    assert (told["session"], told["digest"], told["epoch"]) == ("demo", f"{7:016x}", "8")
    assert {"python", "platform", "farhand", "numpy", "pin", "eclipse-zenoh"} <= told.keys()
    assert incidents(tmp_path) == {}
    status = stream.ring.status
    assert (status.recording, status.written, status.lost) == (True, 2500, 0)


def test_the_files_that_the_session_names_are_in_every_recording(
    tmp_path: Path, stream: TelemetryStream
) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_bytes(b"<robot>\xc2\xb5</robot>")
    named = {"remote.robot.path": str(urdf)}
    recorder = Recorder(stream.ring, options(tmp_path / "out", session_files=named))
    recorder.start()
    urdf.unlink()
    put(stream, 10, FAULT)
    recorder.finish()
    for recording in (recorded(tmp_path / "out"), *incidents(tmp_path / "out").values()):
        assert recording.session_files == {"remote.robot.path": b"<robot>\xc2\xb5</robot>"}


def test_what_arrived_for_a_row_that_is_still_being_written_waits_for_it(
    tmp_path: Path, stream: TelemetryStream
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    for _ in range(3):
        stream.arrived([stream.count.to_bytes(8, "little"), b"second"])
        recorder.drain()
        put_row(stream)
        recorder.drain()
    recorder.finish()
    assert_as_put(recorded(tmp_path))


def test_a_full_disk_loses_nothing_while_there_is_room_in_memory(
    tmp_path: Path, stream: TelemetryStream, disk: Disk
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    put(stream, 100)
    recorder.drain()
    until(lambda: recorder._written == 100, "first rows")
    disk.error = errno.ENOSPC
    put(stream, 100)
    recorder.drain()
    until(lambda: recorder.failed, "failure")
    recorder._report()
    status = stream.ring.status
    assert not status.recording
    assert "No space left" in status.error
    put(stream, 100)
    recorder.drain()
    time.sleep(0.2)
    disk.error = None
    until(lambda: recorder._written == 300, "all rows")
    stream.farewell(1)
    recorder.finish()
    assert stream.ring.status.recording
    recording = recorded(tmp_path)
    assert recording.rows["sequence"].tolist() == list(range(300))
    assert_as_put(recording)
    assert len(list(tmp_path.iterdir())) == 2  # no leftovers of what was tried
    assert not recording.complete  # the first one has no index


def test_a_disk_full_for_long_costs_the_oldest_rows_which_are_counted_and_located(
    tmp_path: Path, stream: TelemetryStream, disk: Disk
) -> None:
    room = 50 * (ROW_BYTES + 2 * ARRIVAL.itemsize)
    recorder = Recorder(stream.ring, options(tmp_path, backlog_bytes=room))
    recorder.start()
    put(stream, 50)
    recorder.drain()
    until(lambda: recorder._written == 50, "first rows")
    disk.error = errno.ENOSPC
    for _ in range(25):
        put(stream, 20)
        recorder.drain()
    until(lambda: recorder.failed, "failure")
    put(stream, 20)
    recorder.drain()
    recorder._report()
    lost = stream.ring.status.lost
    assert lost > 300
    disk.error = None
    until(lambda: recorder._written == stream.count - lost, "the rest")
    stream.farewell(1)
    recorder.finish()
    assert stream.ring.status.lost == lost
    recording = recorded(tmp_path)
    assert sum(gap.rows for gap in recording.gaps) == lost
    assert all(gap.first >= 50 for gap in recording.gaps)
    assert_as_put(recording)
    assert any(
        event.text.startswith("recorder: ") and f"{lost} rows lost" in event.text
        and "No space left" in event.text
        for event in recording.events
    )  # fmt: skip


def test_a_disk_full_to_the_end_is_given_up_and_counted(
    tmp_path: Path, stream: TelemetryStream, disk: Disk
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    put(stream, 50)
    recorder.drain()
    until(lambda: recorder._written == 50, "first rows")
    disk.error = errno.ENOSPC
    put(stream, 70)
    recorder.finish()
    assert recorder.failed
    status = stream.ring.status
    assert (status.recording, status.written, status.lost) == (False, 50, 70)
    assert recorded(tmp_path).rows["sequence"].tolist() == list(range(50))


def test_a_slow_disk_does_not_keep_rows_from_being_drained(
    tmp_path: Path, stream: TelemetryStream, disk: Disk
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    disk.stalled = True
    rows = stream.ring.layout.capacity + 5000  # more than the ring holds
    for _ in range(rows // 500):
        put(stream, 500)
        recorder.drain()
    disk.stalled = False
    stream.farewell(1)
    recorder.finish()
    assert stream.ring.status.lost == 0
    recording = recorded(tmp_path)
    assert recording.rows["sequence"].tolist() == list(range(rows))
    assert_as_put(recording)


def test_rows_overwritten_before_they_were_drained_are_counted_and_located(
    tmp_path: Path, stream: TelemetryStream
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    put(stream, 10)
    recorder.drain()
    put(stream, stream.ring.layout.capacity + 40)
    stream.farewell(1)
    recorder.finish()
    [gap] = recorded(tmp_path).gaps
    assert (gap.first, gap.rows) == (10, 41)
    assert stream.ring.status.lost == 41


def test_segments_rotate_without_a_gap_and_old_ones_go(
    tmp_path: Path, stream: TelemetryStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("telemetry.recorder.SEGMENT_S", 0.1)
    recorder = Recorder(stream.ring, options(tmp_path, keep_s=2.5))  # a segment counts as 1 s
    recorder.start()
    names = set()
    for _ in range(60):
        put(stream, 10)
        recorder.drain()
        time.sleep(0.01)
        names |= {path.name for path in tmp_path.iterdir()}
    stream.farewell(1)
    recorder.finish()
    assert len(names) > 3
    assert len(list(tmp_path.iterdir())) == 3
    recording = recorded(tmp_path)
    assert recording.complete
    assert recording.gaps == ()
    assert recording.rows["sequence"][-1] == 599


def test_a_folder_that_is_deleted_is_made_again(
    tmp_path: Path, stream: TelemetryStream, disk: Disk
) -> None:
    folder = tmp_path / "gone"
    recorder = Recorder(stream.ring, options(folder))
    recorder.start()
    put(stream, 100)
    recorder.drain()
    until(lambda: recorder._written == 100, "first rows")
    shutil.rmtree(folder)
    put(stream, 100)
    recorder.drain()
    until(lambda: recorder._written == 200, "the rest")
    stream.farewell(1)
    recorder.finish()
    assert recorded(folder).rows["sequence"].tolist() == list(range(100, 200))


def test_incidents_wait_for_a_disk_that_fails(
    tmp_path: Path, stream: TelemetryStream, disk: Disk
) -> None:
    recorder = Recorder(stream.ring, options(tmp_path))
    recorder.start()
    put(stream, 100)
    put(stream, 1, FAULT)
    recorder.drain()
    until(lambda: recorder._written == 101, "rows")
    disk.error = errno.EIO
    recorder._incidents.extend(recorder._watch.end(died=False))
    until(lambda: recorder.failed, "failure")
    disk.error = None
    until(lambda: recorder._incidents_written == 1, "the incident")
    [(why, incident)] = incidents(tmp_path).items()
    assert why == "fault"
    assert len(incident.rows) == 101
    assert incident.complete
    stream.farewell(1)
    recorder.finish()


def test_the_backlog_drops_the_oldest_and_keeps_the_order() -> None:
    def piece(first: int, rows: int) -> Piece:
        made = np.zeros(rows, row_dtype(2, 2))
        made["sequence"] = np.arange(first, first + rows)
        return Piece(made, (SiteEvent(first, "x"),))

    backlog = Backlog(10 * ROW_BYTES)
    backlog.put(piece(0, 4))
    backlog.put(piece(4, 4))
    taken = backlog.take(5)
    assert taken is not None
    assert taken.rows["sequence"].tolist() == [0, 1, 2, 3]
    backlog.put_back(taken)
    backlog.put(piece(8, 4))
    assert backlog.dropped == 4
    left = backlog.take(100)
    assert left is not None
    assert left.rows["sequence"].tolist() == list(range(4, 12))
    assert [event.stamp_ns for event in left.events] == [4, 8]
    assert backlog.take(100) is None


class Run:
    """A stream in shared memory and the process that records it."""

    def __init__(self, folder: Path) -> None:
        self.memory = SharedMemory()
        self.stream = TelemetryStream(2, 2, 0, 7, 8, lambda _: None, allocate=self.memory.allocate)
        self.recorder = RecorderProcess(self.stream.ring, self.memory, options(folder))

    def until_written(self) -> None:
        until(lambda: self.stream.ring.status.written == self.stream.count, "all rows written")

    def close(self) -> None:
        self.recorder.close()
        self.memory.close()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    run = Run(tmp_path / "deep" / "folder")
    yield run
    run.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "deep" / "folder"


def test_a_process_records_until_the_farewell(run: Run, folder: Path) -> None:
    put(run.stream, 700)
    run.stream.farewell(time.monotonic_ns())
    run.recorder.close()
    assert run.recorder.trouble is None
    recording = recorded(folder)
    assert recording.complete
    assert recording.rows.tobytes() == run.stream.last(700).tobytes()
    assert incidents(folder) == {}
    wall_s = recording.wall_times_ns[-1] * 1e-9
    assert abs(wall_s - time.time()) < DEADLINE_S


def test_a_site_that_ends_without_farewell_is_an_incident(run: Run, folder: Path) -> None:
    put(run.stream, 300)
    run.recorder.close()
    recording = recorded(folder)
    assert recording.complete
    assert len(recording.rows) == 300
    assert recording.events[-1].text == "recorder: ended without farewell"
    [(why, incident)] = incidents(folder).items()
    assert why == "died"
    assert incident.rows.tobytes() == recording.rows.tobytes()
    assert incident.metadata == recording.metadata
    assert incident.session_text == "format = 1\n"
    assert run.recorder.incidents == 1


def test_the_recorder_stands_back_and_stays(run: Run, folder: Path) -> None:
    pid = run.recorder.pid
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        os.kill(pid, number)
    assert os.sched_getscheduler(pid) == os.SCHED_OTHER
    assert os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0), (
        "any job on the machine would go first"
    )
    assert os.getsid(pid) == pid
    put(run.stream, 100)
    run.until_written()
    assert run.recorder.trouble is None


def test_a_recorder_that_is_killed_leaves_what_it_wrote_and_is_reported(
    run: Run, folder: Path
) -> None:
    put(run.stream, 400)
    run.until_written()
    os.kill(run.recorder.pid, signal.SIGKILL)
    until(lambda: run.recorder.trouble is not None, "the end noticed")
    assert "ended with code -9" in (run.recorder.trouble or "")
    put(run.stream, 100)  # nothing to the site
    recording = recorded(folder)
    assert not recording.complete
    assert recording.rows["sequence"].tolist() == list(range(400))


def test_a_recorder_that_is_held_up_is_reported_and_catches_up(run: Run, folder: Path) -> None:
    os.kill(run.recorder.pid, signal.SIGSTOP)
    put(run.stream, 6000)
    assert "rows behind" in (run.recorder.trouble or "")
    os.kill(run.recorder.pid, signal.SIGCONT)
    run.until_written()
    assert run.recorder.trouble is None
    run.stream.farewell(1)
    run.recorder.close()
    assert recorded(folder).rows["sequence"].tolist() == list(range(6000))


def test_an_end_does_not_wait_for_ever_and_what_is_left_is_written_later(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("telemetry.recorder_process._END_S", 0.2)
    os.kill(run.recorder.pid, signal.SIGSTOP)
    put(run.stream, 300)
    run.stream.farewell(1)
    run.recorder.close()
    assert run.recorder.trouble == "the recorder still writes, 300 rows are left"
    os.kill(run.recorder.pid, signal.SIGCONT)
    until(lambda: run.recorder.trouble is None, "its end")
    assert recorded(folder).rows["sequence"].tolist() == list(range(300))


def test_where_nothing_can_be_written_the_start_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(TelemetryError, match=r"cannot record in .*file/below: .*Not a directory"):
        Run(tmp_path / "file" / "below")
