"""The flight recorder of real daemons: killed, held up, without room, at the end of a run."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from site_runtime.supervisor import State
from telemetry.recording import Recording, read_recording
from tests.ports import free_port

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
DEADLINE_S = 30.0
ORPHAN_S = "150"  # a daemon whose test was killed ends by itself

SESSION = """
format = 1
name = "flight"
loop = { rate_hz = 1000 }
task = { dimension = 2 }
coupling = { law = "stiffness", stiffness_n_per_m = [100.0, 100.0], force_ceiling_n = [9.0, 9.0] }
recorder = { RECORDER }
[local]
damping = { joint_nm_s = [0.2, 0.2], task_n_s_per_m = [15.0, 15.0] }
device = { driver = "simulated", initial_position_rad = [-0.3, 1.65], brakes = false }
robot = { kind = "planar", lengths_m = [0.4, 0.4], masses_kg = [1.0, 1.0] }
operator = { kind = "constant", force_n = [FORCE, 0.0], start_s = START }
[remote]
damping = { joint_nm_s = [0.2, 0.2], task_n_s_per_m = [15.0, 15.0] }
device = { driver = "simulated", initial_position_rad = [-0.3, 1.65] }
robot = { kind = "planar", lengths_m = [0.4, 0.4], masses_kg = [1.0, 1.0] }
"""


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@dataclass
class Daemon:
    """A local site alone: it ticks, waits for a peer, and is recorded."""

    folder: Path
    recorder: str = ""
    force_n: float = 0.0
    start_s: float = 0.0
    before: tuple[str, ...] = ()
    process: "subprocess.Popen[bytes]" = field(init=False)

    def start(self, *options: str) -> None:
        text = SESSION.replace("RECORDER", self.recorder)
        text = text.replace("FORCE", str(self.force_n)).replace("START", str(self.start_s))
        session = self.folder / "session.toml"
        session.write_text(text, encoding="utf-8")
        command = [
            *(*self.before, sys.executable, "-m", "local_site", str(session)),
            *("--listen", free_endpoint(), "--connect", free_endpoint()),
            *("--duration", ORPHAN_S, *options),
        ]
        self.log = self.folder / "log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                command,
                cwd=ROOT,
                stdout=log,
                stderr=log,
                env=os.environ | {"XDG_STATE_HOME": str(self.folder / "state")},
            )

    @property
    def recordings(self) -> Path:
        return self.folder / "state" / "farhand" / "flight" / "local"

    def text(self) -> str:
        return " ".join(re.sub("[─-╿]", " ", self.log.read_text(encoding="utf-8")).split())

    def recorded(self) -> Recording:
        return read_recording(*sorted(self.recordings.glob("rows-*.mcap")))["local"]

    def incident(self, why: str) -> Recording:
        [path] = self.recordings.glob(f"incident-*-local-{why}.mcap")
        return read_recording(path)["local"]

    def recorder_pid(self) -> int:
        """The child that the daemon started."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        [pid] = [int(pid) for pid in children.read_text(encoding="ascii").split()]
        return pid

    def until_recording(self) -> None:
        """Until the recorder has told the site that it records: the file comes before that."""
        self.until(
            lambda: any(self.recordings.glob("rows-*.mcap")) and "recording in" in self.text(),
            "a recording",
        )

    def until(self, condition: Callable[[], object], what: str) -> None:
        end_s = time.monotonic() + DEADLINE_S
        while not condition():
            if time.monotonic() > end_s:
                pytest.fail(f"not within {DEADLINE_S} s: {what}\n{self.text()}")
            time.sleep(0.01)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(DEADLINE_S)

    def close(self) -> None:
        if hasattr(self, "process") and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    daemon = Daemon(tmp_path)
    yield daemon
    daemon.close()


def recorder_ended(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return True
    return stat.rpartition(")")[2].split()[0] == "Z"


def assert_undisturbed(recording: Recording) -> None:
    """A loop that waited for its recorder would miss seconds; a crowded machine costs less."""
    missed = recording.rows["missed"].astype(int)
    assert missed[-1] - missed[0] < 0.1 * len(missed)


def test_a_run_is_recorded_from_its_first_tick_to_its_last(daemon: Daemon) -> None:
    daemon.start()
    daemon.until_recording()
    time.sleep(1.0)
    assert daemon.stop() == 0
    text = daemon.text()
    assert f"recording in {daemon.recordings}" in text
    ticks = int(re.search(r"ticks (\d+) run", text)[1])  # type: ignore[index]
    recording = daemon.recorded()
    assert recording.complete
    assert recording.rows["sequence"].tolist() == list(range(ticks))
    assert recording.events[-1].text == "farewell"
    assert recording.session_text == (daemon.folder / "session.toml").read_text(encoding="utf-8")
    assert "FAULT" in recording.metadata["states"]
    assert list(daemon.recordings.glob("incident-*")) == []


@pytest.mark.parametrize("moment", range(4))
def test_a_site_killed_at_any_moment_is_recorded_to_its_last_tick(
    daemon: Daemon, moment: int
) -> None:
    daemon.start("--quiet")
    daemon.until_recording()
    pid = daemon.recorder_pid()
    time.sleep(random.uniform(0.3, 1.5))  # noqa: S311 - no secret
    killed_ns = time.monotonic_ns()
    daemon.process.kill()
    daemon.process.wait()
    daemon.until(lambda: recorder_ended(pid), "the recorder's end")
    recording = daemon.recorded()
    assert recording.complete
    assert recording.rows["sequence"].tolist() == list(range(len(recording.rows)))
    # a tick may have been late on a crowded machine: by as much as it ever was before
    late_ns = int(np.diff(recording.rows["stamp_ns"]).max())
    assert killed_ns - recording.rows["stamp_ns"][-1] < max(100_000_000, 2 * late_ns)
    assert recording.events[-1].text == "recorder: ended without farewell"
    died = daemon.incident("died").rows
    assert died["sequence"].tolist() == recording.rows["sequence"].tolist()[-len(died) :]


def test_a_killed_recorder_leaves_a_readable_file_and_the_site_runs_on(daemon: Daemon) -> None:
    daemon.start("--quiet")
    daemon.until_recording()
    pid = daemon.recorder_pid()
    time.sleep(1.0)
    killed_ns = time.monotonic_ns()
    os.kill(pid, signal.SIGKILL)
    time.sleep(0.5)
    assert daemon.stop() == 0
    assert "the recorder ended with code -9" in daemon.text()
    recording = daemon.recorded()
    assert not recording.complete
    assert recording.gaps == ()
    assert killed_ns - recording.rows["stamp_ns"][-1] < 300_000_000  # 50 ms where nobody is late


def test_a_recorder_held_up_for_seconds_loses_nothing(daemon: Daemon) -> None:
    daemon.start("--quiet")
    daemon.until_recording()
    pid = daemon.recorder_pid()
    os.kill(pid, signal.SIGSTOP)
    time.sleep(3.0)
    os.kill(pid, signal.SIGCONT)
    assert daemon.stop() == 0
    daemon.until(lambda: daemon.recorded().complete, "the recorder's end")
    assert "rows not recorded" not in daemon.text()
    recording = daemon.recorded()
    assert recording.gaps == ()
    assert recording.rows["sequence"][-1] > 1000
    assert_undisturbed(recording)


def test_a_fault_keeps_the_five_seconds_before_it(daemon: Daemon) -> None:
    # no arm withstands this blow, nor does the simulation
    daemon.force_n, daemon.start_s = 1e9, 6.0
    daemon.start("--quiet")
    daemon.until(lambda: list(daemon.recordings.glob("incident-*.mcap")), "an incident")
    assert daemon.stop() == 1
    assert "incidents 1 kept in" in daemon.text()
    incident = daemon.incident("fault")
    whole = daemon.recorded().rows
    fault_ns = int(whole["stamp_ns"][np.argmax(whole["state"] == State.FAULT)])
    since_ns = whole["stamp_ns"] - fault_ns
    around = whole[(since_ns >= -5_000_000_000) & (since_ns <= 1_000_000_000)]
    assert incident.rows.tobytes() == around.tobytes()
    assert (around["stamp_ns"][-1] - around["stamp_ns"][0]) * 1e-9 > 4.0
    assert incident.gaps == ()


def can_mount(folder: Path) -> bool:
    if shutil.which("unshare") is None:
        return False
    command = ["unshare", "-m", "mount", "-t", "tmpfs", "none", str(folder)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def test_a_full_disk_never_disturbs_the_loop_and_recording_goes_on_after_it(
    daemon: Daemon,
) -> None:
    if not can_mount(daemon.folder):
        pytest.skip("a small disk needs the right to mount one in a namespace of its own")
    daemon.recordings.mkdir(parents=True)
    mount = f'mount -t tmpfs -o size=128k none "{daemon.recordings}" && exec "$@"'
    daemon.before = ("unshare", "-m", "sh", "-c", mount, "sh")
    daemon.start()
    # its own view of the folder: that of the test has no such mount
    outside = daemon.recordings
    inside = Path(f"/proc/{daemon.process.pid}/root") / str(outside).lstrip("/")
    daemon.until(lambda: any(inside.glob("rows-*.mcap")), "a recording")
    daemon.until(lambda: "not recording: " in daemon.text(), "the failure in the status line")
    assert "No space left on device" in daemon.text()
    first = sorted(inside.glob("rows-*.mcap"))
    kept = daemon.folder / "kept.mcap"
    shutil.move(first[0], kept)
    for path in first[1:]:
        path.unlink()
    time.sleep(1.5)
    again = sorted(inside.glob("rows-*.mcap"))
    assert again
    shutil.copy(again[0], daemon.folder / "again.mcap")
    assert daemon.stop() == 0
    recording = read_recording(kept, daemon.folder / "again.mcap")["local"]
    assert recording.gaps == ()  # memory held what the disk did not take
    assert_undisturbed(recording)


def test_without_a_recorder_nothing_is_written(daemon: Daemon) -> None:
    daemon.start("--no-record", "--duration", "1")
    assert daemon.process.wait(DEADLINE_S) == 0
    assert not daemon.recordings.exists()
    assert "recording" not in daemon.text()


def test_where_it_records_and_what_stops_it_is_said_before_the_start(daemon: Daemon) -> None:
    (daemon.folder / "file").touch()
    daemon.recorder = 'directory = "file"'
    daemon.start()
    assert daemon.process.wait(DEADLINE_S) == 2
    text = daemon.text()
    assert "the flight recorder cannot record in" in text
    assert "Not a directory" in text
    assert "--no-record" in text
    assert "Traceback" not in text
