"""`farhand demo` as a process: two daemons, Zenoh, a dashboard that serves and saves."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun_cli

from tests.ports import free_port

pytestmark = pytest.mark.processes
DEADLINE_S = 120.0


@pytest.fixture
def ports() -> list[int]:
    return [free_port(), free_port()]


@pytest.fixture
def start(ports: list[int]) -> Iterator:
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "farhand", "demo", "--port", str(ports[0])]
        process = subprocess.Popen(
            [*command, "--web-port", str(ports[1]), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_it_runs_both_sites_serves_the_dashboard_and_saves_it(start, tmp_path: Path) -> None:
    saved = tmp_path / "demo.rrd"
    process = start("--duration", "12", "--save", str(saved))
    out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, err
    assert "dashboard: " in err
    for site in ("local site", "remote site"):
        assert site in out
    binary = Path(rerun_cli.__file__).with_name("rerun")
    verified = subprocess.run(
        [binary, "rrd", "verify", saved], capture_output=True, text=True, timeout=DEADLINE_S
    )
    assert verified.returncode == 0, verified.stderr
    printed = subprocess.run(
        [binary, "rrd", "stats", saved], capture_output=True, text=True, timeout=DEADLINE_S
    )
    for entity in ("/error/local", "/torque/remote", "/round_trip/certified"):
        assert entity in printed.stdout


def test_ctrl_c_ends_it_cleanly(start) -> None:
    process = start()
    for line in process.stderr:
        if line.startswith("dashboard: "):
            break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, err
    assert "Traceback" not in err
