"""`farhand record` of sites that publish on loopback."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from channel.zenoh_link import ZenohNode, ZenohSettings
from experiments.simulation import Run
from farhand import record as record_command
from farhand.__main__ import app
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.session import Session
from telemetry.recorded_runs import recorded_runs, recording_files
from telemetry.rows import LAYOUT_VERSION, RowArray
from telemetry.stream import _HEADER, MAGIC
from tests.ports import free_port

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
DEADLINE_S = 60.0
BATCH = 50


def payload(rows: RowArray, site: SiteId, digest: int) -> bytes:
    """What a site publishes of these rows."""
    shape = (site, rows["q"].shape[1], rows["position_m"].shape[1])
    numbers = (len(rows), digest, 9 + site, int(rows["sequence"][0]))
    return _HEADER.pack(MAGIC, LAYOUT_VERSION, *shape, *numbers) + rows.tobytes()


class Sites:
    """Both sites' publishers: they repeat the same rows, numbered on, until told to stop."""

    def __init__(self, session: Session, run: Run) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._session = session
        self._rows = (run.local, run.remote)
        self._node = ZenohNode(ZenohSettings(listen=(self.endpoint,)))
        self._publish = [self._node.publisher(telemetry_key(session.name, s)) for s in SiteId]
        self.skipped: list[int] = []
        self.strangers = False
        self._skip = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._go)
        self._thread.start()

    def skip(self) -> None:
        """Lose the next batch of the local site."""
        self._skip += 1

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self._node.close()

    def _go(self) -> None:
        first = 0
        while not self._ending.wait(0.02):
            if self.strangers:
                self._publish[0](payload(self._rows[0][:BATCH], SiteId.LOCAL, 1))
                self._publish[0](b"what is this")
            for site, rows in zip(SiteId, self._rows, strict=True):
                part = rows[first % 1000 :][:BATCH].copy()
                part["sequence"] += first - first % 1000
                part["stamp_ns"] = time.monotonic_ns() + part["time_ns"] - part["time_ns"][-1]
                if self._skip and site is SiteId.LOCAL:
                    self._skip -= 1
                    self.skipped.append(int(part["sequence"][0]))
                    continue
                self._publish[site](payload(part, site, self._session.digest))
            first += BATCH


@pytest.fixture
def sites(demo_session: Session, demo_run: Run) -> Iterator[Sites]:
    with closing(Sites(demo_session, demo_run)) as both:
        yield both


def start(out: Path, *arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "farhand", "record", DEMO, "--out", out, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=DEMO.parents[1],
        env=os.environ | {"COLUMNS": "200"},
    )


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def wait_for(process: "subprocess.Popen[str]", *words: str) -> str:
    """Read what it says until all these words have come."""
    said = ""
    assert process.stdout is not None
    while not all(word in said for word in words):
        line = process.stdout.readline()
        assert line, said
        said += line
    return said


def record(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["record", *map(str, arguments)], env={"COLUMNS": "200"})


@pytest.mark.processes
def test_both_sites_are_recorded_and_gaps_and_strangers_told(
    sites: Sites, tmp_path: Path, demo_session: Session
) -> None:
    out = tmp_path / "out"
    process = start(out, "--connect", sites.endpoint)
    try:
        until(lambda: len(list(out.glob("*.mcap"))) == 2)
        time.sleep(0.3)
        sites.skip()
        sites.strangers = True  # again and again: on a crowded machine what is published may drop
        said = wait_for(process, "rows lost", "another session file", "no telemetry")
        process.send_signal(signal.SIGINT)
        said += process.communicate(timeout=DEADLINE_S)[0]
    finally:
        process.kill()
    assert process.returncode == 0, said
    lost = f"50 rows lost from row {sites.skipped[0]} on"
    assert f"local: {lost}" in said
    assert re.search(r"\d+ batches were of another session file and not recorded", said)
    assert re.search(r"\d+ payloads were no telemetry of this version and not recorded", said)
    runs = {run.metadata["site"]: run for run in recorded_runs(recording_files([out]))}
    assert set(runs) == {"local", "remote"}
    for site, run in runs.items():
        assert run.complete
        assert run.metadata["digest"] == f"{demo_session.digest:016x}"
        assert run.metadata["source"] == "network"
        assert run.session_text == demo_session.text
        assert re.search(rf"^{site}: {len(run.rows)} rows of run \d+, ", said, re.MULTILINE)
    assert [(gap.first, gap.rows) for gap in runs["local"].gaps] == [(sites.skipped[0], 50)]
    assert [event.text for event in runs["local"].events] == [f"recorder: {lost}"]
    assert f"1 gaps: 50 from row {sites.skipped[0]} on" in said
    assert runs["remote"].gaps == ()


@pytest.mark.processes
def test_a_killed_recorder_leaves_readable_files(sites: Sites, tmp_path: Path) -> None:
    process = start(tmp_path / "out", "--connect", sites.endpoint)
    until(lambda: sum(f.stat().st_size for f in tmp_path.rglob("*.mcap")) > 200_000)
    process.kill()
    process.communicate()
    runs = recorded_runs(recording_files([tmp_path / "out"]))
    assert {run.metadata["site"] for run in runs} == {"local", "remote"}
    assert all(len(run.rows) > 100 and run.gaps == () for run in runs)


def test_who_is_heard_again_is_told(
    sites: Sites, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_command, "SILENT_S", 0.0)
    wish = (DEMO, "--out", tmp_path / "out", "--duration", "2", "--connect", sites.endpoint)
    result = record(*wish)
    assert result.exit_code == 0
    for site in ("local", "remote"):
        assert f"{site}: heard again" in result.output


def test_nothing_heard_is_told_and_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_command, "SILENT_S", 0.2)
    result = record(
        *(DEMO, "--out", tmp_path / "out", "--duration", "0.5"),
        *("--connect", "tcp/127.0.0.1:1"),
    )
    assert result.exit_code == 1
    assert "nothing was recorded" in result.output
    for site in ("local", "remote"):
        assert result.output.count(f"{site}: nothing heard for 0.2 s") == 1


def test_silence_and_its_end_are_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record_command, "SILENT_S", 0.2)
    hearing = record_command._Hearing()
    assert hearing.changes() == []
    time.sleep(0.3)
    hearing.heard(SiteId.LOCAL)
    assert hearing.changes() == ["remote: nothing heard for 0.2 s"]
    assert hearing.changes() == []
    hearing.heard(SiteId.REMOTE)
    hearing.heard(SiteId.REMOTE)
    assert hearing.changes() == ["remote: heard again"]


def test_a_folder_that_holds_recordings_is_added_to_only_by_force(tmp_path: Path) -> None:
    (tmp_path / "rows-x-local.mcap").touch()
    wish = (DEMO, "--out", tmp_path, "--duration", "0.2", "--connect", "tcp/127.0.0.1:1")
    result = record(*wish)
    assert result.exit_code == 2, result.output
    assert "--force" in result.output
    forced = record(*wish, "--force")
    assert forced.exit_code == 1, forced.output
    assert "nothing was recorded" in forced.output


def test_a_place_that_cannot_be_written_is_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = record(DEMO, "--out", tmp_path / "file" / "out")
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_without_a_folder_it_makes_one_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record(DEMO, "--duration", "0.1", "--connect", "tcp/127.0.0.1:1")
    [made] = tmp_path.iterdir()
    assert re.fullmatch(r"demo-\d{8}T\d{6}Z", made.name)
