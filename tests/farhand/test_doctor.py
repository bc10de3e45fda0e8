"""`farhand doctor` on this machine, for a second; whether it holds the rate is not the test's."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from farhand import doctor as doctor_module
from farhand.__main__ import app
from farhand.doctor import _simulated
from hardware.simulated import SimulatedSettings
from site_runtime.doctor_findings import Finding, Verdict
from site_runtime.session import load_session
from site_runtime.session_edit import edited
from tests.ports import free_port

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
VERDICTS = {verdict.value for verdict in Verdict}


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.mark.processes
def test_the_doctor_looks_at_everything() -> None:
    result = CliRunner().invoke(app, ["doctor", "--seconds", "0.5", "--json"])
    told = json.loads(result.stdout)
    assert result.exit_code == (0 if told["holds_the_rate"] else 1)
    assert (told["session"], told["rate_hz"]) == ("demo", 1000)
    found = {finding["what"]: finding for finding in told["findings"]}
    assert list(found) == [
        "kernel",
        "privileges",
        "governor",
        "cores",
        "clock",
        "lateness, ordinary",
        "lateness, SCHED_FIFO 80",
        "local tick",
        "load",
        "disk writes",
        "free disk",
    ]
    assert {finding["verdict"] for finding in found.values()} <= VERDICTS
    assert "ticks missed, at 1000 Hz" in found["lateness, ordinary"]["measured"]
    assert found["local tick"]["verdict"] != "not measured", found["local tick"]
    assert [what for what, finding in found.items() if finding["decisive"]] == [
        "lateness, SCHED_FIFO 80",
        "local tick",
    ]


@pytest.mark.processes
def test_two_doctors_measure_the_way_between_them(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "session.toml"
    demo = load_session(EXPERIMENTS / "demo.toml")
    changes = {"network.local_connect": endpoint, "network.remote_listen": endpoint}
    file.write_text(edited(demo.text, changes), encoding="utf-8")
    command = [sys.executable, "-m", "farhand", "doctor", str(file), "--answer"]
    other = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None
        assert f"answering at {endpoint}" in other.stdout.readline()
        found = doctor_module._round_trip(load_session(file), 0.5)
    finally:
        other.send_signal(signal.SIGINT)
        told, _ = other.communicate(timeout=30)
    assert found.what == "round trip"
    assert found.verdict is not Verdict.NOT_MEASURED, found.measured
    assert "answered" in told
    assert told.strip() != "0 answered"
    assert other.returncode == 0


@pytest.mark.parametrize(
    "network",
    [
        {"security": "mtls", "keys": "keys", "local_connect": "tls/127.0.0.1:1"},
        {"router": "tcp/127.0.0.1:1"},
    ],
)
def test_where_a_doctor_is_let_in_by_nobody_the_link_test_is_named(
    tmp_path: Path, network: dict[str, str]
) -> None:
    file = tmp_path / "session.toml"
    demo = load_session(EXPERIMENTS / "demo.toml")
    changes = {f"network.{key}": value for key, value in network.items()}
    file.write_text(edited(demo.text, changes), encoding="utf-8")
    found = doctor_module._round_trip(load_session(file), 0.1)
    assert found.verdict is Verdict.NOT_MEASURED
    assert "link-test" in found.change
    answering = CliRunner().invoke(app, ["doctor", str(file), "--answer"])
    assert answering.exit_code == 2
    assert "link-test" in answering.output


def test_the_exit_code_and_the_table_tell_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Finding("kernel", Verdict.WILL_DO, "[old]", "a newer one"),
        Finding("tick", Verdict.NOT_GOOD, "p50 9000 µs", "rate_hz = 50", decisive=True),
    ]
    monkeypatch.setattr(doctor_module, "_examine", lambda *_, **__: iter(found))
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    for words in ("[old]", "a newer one", "rate_hz = 50", "does not hold 1000 Hz"):
        assert words in result.output
    found[1] = Finding("tick", Verdict.NOT_MEASURED, "never engaged", decisive=True)
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert "could not be measured" in result.output
    found.pop()
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 0
    assert "this machine holds 1000 Hz" in result.output


def test_who_asks_the_other_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, bool]] = []

    def examine(session: object, identity: object, seconds: float, *, asks: bool) -> object:
        asked.append((identity.label, asks))  # type: ignore[attr-defined]
        return iter(())

    monkeypatch.setattr(doctor_module, "_examine", examine)
    demo = str(EXPERIMENTS / "demo.toml")
    for arguments in ([], [demo], [demo, "--site", "remote"]):
        assert CliRunner().invoke(app, ["doctor", *arguments]).exit_code == 0
    assert asked == [("local", False), ("local", True), ("remote", False)]


def test_real_robots_are_left_alone() -> None:
    session = _simulated(load_session(EXPERIMENTS / "bench_fake.toml"))
    for site in (session.local, session.remote):
        assert isinstance(site.device, SimulatedSettings)
        assert site.force_sensor is None
    assert session.engagement.alignment == "none"
    demo = load_session(EXPERIMENTS / "demo.toml")
    assert _simulated(demo).local.device == demo.local.device


def test_a_bad_session_is_a_users_error(tmp_path: Path) -> None:
    start_s = time.monotonic()
    result = CliRunner().invoke(app, ["doctor", str(tmp_path / "absent.toml")])
    assert result.exit_code == 2
    assert time.monotonic() - start_s < 60.0
