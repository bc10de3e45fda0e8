"""What systemd hears on its socket: of a fake loop, and of real processes."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from site_runtime.daemon_log import DaemonLog
from site_runtime.service_manager import ServiceKeeper, ServiceManager

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "experiments" / "demo.toml"
DEADLINE_S = 30.0
WATCHDOG_S = 2.0
READY, ALIVE, STOPPING = b"READY=1", b"WATCHDOG=1", b"STOPPING=1"


class Ear:
    """The socket of a service manager."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)
        self._socket.settimeout(DEADLINE_S)

    def next(self) -> bytes:
        return self._socket.recv(100)

    def waiting(self) -> list[bytes]:
        heard = []
        self._socket.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                heard.append(self._socket.recv(100))
        self._socket.settimeout(DEADLINE_S)
        return heard

    def until(self, what: bytes) -> None:
        while self.next() != what:
            pass

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def ear(request: pytest.FixtureRequest) -> Iterator[Ear]:
    with tempfile.TemporaryDirectory(prefix="farhand-") as folder:  # tmp_path may be too long
        address = f"{folder}/notify" if request.param == "path" else f"@{folder}"
        with closing(Ear(address)) as ear:
            yield ear


def test_a_loop_that_ticks_is_ready_once_and_alive_until_it_stands_still(ear: Ear) -> None:
    ticks = [0]
    with closing(ServiceManager({"NOTIFY_SOCKET": ear.address})) as manager:
        keeper = ServiceKeeper(manager, lambda: ticks[0], DaemonLog("remote"))
        keeper.look()
        assert ear.waiting() == []
        ticks[0] = 1
        keeper.look()
        assert ear.waiting() == [READY, ALIVE]
        keeper.look()
        assert ear.waiting() == []
        ticks[0] = 2
        keeper.look()
        assert ear.waiting() == [ALIVE]


def test_nobody_to_tell_is_no_error(ear: Ear) -> None:
    for named in ({}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}):
        with closing(ServiceManager(named)) as manager:
            assert not manager.listens
            manager.ready()
    with closing(ServiceManager({"NOTIFY_SOCKET": ear.address})) as manager:
        assert manager.listens
        ear.close()
        manager.ready()
        manager.close()
        manager.alive()


def test_a_manager_that_does_not_read_blocks_nobody(ear: Ear) -> None:
    with closing(ServiceManager({"NOTIFY_SOCKET": ear.address})) as manager:
        for _ in range(10_000):
            manager.alive()
    assert 0 < len(ear.waiting()) < 10_000


@pytest.mark.parametrize(
    ("environment", "expected_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "3000000"}, 3.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 3.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid() + 1)}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_the_watchdog_is_the_one_meant_for_this_process(
    environment: dict[str, str], expected_s: float | None
) -> None:
    with closing(ServiceManager(environment)) as manager:
        assert manager.watchdog_s == expected_s


def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def start(ear: Ear) -> Iterator:
    started: list[subprocess.Popen[bytes]] = []

    def start(*command: str | Path) -> subprocess.Popen[bytes]:
        watchdog = {"NOTIFY_SOCKET": ear.address, "WATCHDOG_USEC": f"{WATCHDOG_S * 1e6:.0f}"}
        process = subprocess.Popen(
            [sys.executable, "-m", *command],
            cwd=ROOT,
            env=os.environ | watchdog,
            stdin=subprocess.DEVNULL,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def silent(ear: Ear) -> bool:
    """Whether nothing is told for as long as the watchdog waits."""
    time.sleep(WATCHDOG_S / 4)  # what was on its way
    ear.waiting()
    time.sleep(WATCHDOG_S)
    return ear.waiting() == []


@pytest.mark.patient
@pytest.mark.parametrize("ear", ["path"], indirect=True)
def test_a_site_whose_loop_hangs_pings_no_more_though_its_other_threads_live(
    ear: Ear, start
) -> None:
    process = start("tests.fakes.hanging_site", DEMO, endpoint())
    assert ear.next() == READY
    since_s = time.monotonic()
    for _ in range(8):
        assert ear.next() == ALIVE
    assert time.monotonic() - since_s < 8 * WATCHDOG_S
    process.send_signal(signal.SIGALRM)
    assert silent(ear)
    assert process.poll() is None
    process.send_signal(signal.SIGALRM)
    ear.until(ALIVE)
    process.send_signal(signal.SIGTERM)
    ear.until(STOPPING)
    assert process.wait(DEADLINE_S) == 0


@pytest.mark.patient
@pytest.mark.parametrize("ear", ["path"], indirect=True)
def test_a_site_that_cannot_start_is_never_ready(ear: Ear, start, tmp_path: Path) -> None:
    process = start("remote_site", tmp_path / "absent.toml")
    assert process.wait(DEADLINE_S) == 2
    assert ear.waiting() == []


@pytest.mark.patient
@pytest.mark.parametrize("ear", ["path"], indirect=True)
def test_a_suspended_relay_pings_no_more(ear: Ear, start, tmp_path: Path) -> None:
    session = tmp_path / "session.toml"
    router = endpoint()
    text = DEMO.read_text(encoding="utf-8")
    session.write_text(text.replace("[network]\n", f'[network]\nrouter = "{router}"\n'), "utf-8")
    process = start("farhand", "router", session)
    assert ear.next() == READY
    for _ in range(3):
        assert ear.next() == ALIVE
    process.send_signal(signal.SIGSTOP)
    assert silent(ear)
    process.send_signal(signal.SIGCONT)
    ear.until(ALIVE)
    process.send_signal(signal.SIGTERM)
    ear.until(STOPPING)
    assert process.wait(DEADLINE_S) == 0
