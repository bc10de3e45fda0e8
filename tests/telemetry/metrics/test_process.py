"""The endpoint as a process: scraped while rows are put, killed, held up, without its port."""

import os
import signal
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from telemetry.companion import SharedMemory
from telemetry.metrics.process import MetricsProcess
from telemetry.rows import COLUMNS, TelemetryError
from telemetry.stream import TelemetryStream
from tests.telemetry.metrics.test_site_metrics import LENGTHS, OPTIONS

DEADLINE_S = 30.0


def until(condition: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end_s, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.005)


class Run:
    """A stream in shared memory, and the process that tells its metrics."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self.memory = SharedMemory()
        self.stream = TelemetryStream(2, 2, 0, 7, 8, lambda _: None, allocate=self.memory.allocate)
        options = replace(OPTIONS, host=host, port=port)
        try:
            self.metrics = MetricsProcess(self.memory, options)
        except TelemetryError:
            self.memory.close()
            raise

    def put(self, rows: int) -> None:
        row = {
            name: np.zeros(LENGTHS[column.axis], column.format)
            for name, column in COLUMNS.items()
            if name != "sequence"
        }
        for _ in range(rows):
            self.stream.put(**row)

    def scrape(self) -> dict[str, float]:
        with urllib.request.urlopen(self.metrics.url, timeout=DEADLINE_S) as answer:  # noqa: S310
            text = answer.read().decode()
        return {
            sample.name: sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
            if len(sample.labels) == 2
        }

    def close(self) -> None:
        self.metrics.close()
        self.memory.close()


@pytest.fixture
def run() -> Iterator[Run]:
    run = Run()
    yield run
    run.close()


def test_a_scrape_tells_what_was_put_up_to_it(run: Run) -> None:
    for rows in (700, 1, 300):
        run.put(rows)
        found = run.scrape()
        assert found["farhand_ticks_total"] == run.stream.count
        assert found["farhand_wakeup_lateness_seconds_count"] == run.stream.count
    assert found["farhand_metrics_rows_lost_total"] == 0


def test_rows_are_counted_while_nobody_asks(run: Run) -> None:
    # more than the ring holds, at a pace that its reader can follow
    rows = run.stream.ring.layout.capacity * 3 // 2
    for _ in range(30):
        run.put(rows // 30)
        time.sleep(0.06)
    found = run.scrape()
    assert found["farhand_ticks_total"] == rows
    lost = found["farhand_metrics_rows_lost_total"]
    assert found["farhand_wakeup_lateness_seconds_count"] + lost == rows
    assert lost < rows / 3  # none, but on a machine too busy for a second


def test_it_stands_back_and_stays_until_the_site_ends(run: Run) -> None:
    pid = run.metrics.pid
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        os.kill(pid, number)
    assert os.sched_getscheduler(pid) == os.SCHED_OTHER
    assert os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getsid(pid) == pid
    run.put(100)
    assert run.scrape()["farhand_ticks_total"] == 100
    assert run.metrics.trouble is None
    run.metrics.close()
    assert run.metrics.trouble == "no metrics: their process ended with code 0"


def test_one_that_is_killed_is_told(run: Run) -> None:
    os.kill(run.metrics.pid, signal.SIGKILL)
    until(lambda: run.metrics.trouble is not None, "its end noticed")
    assert "ended with code -9" in (run.metrics.trouble or "")
    run.put(100)


def test_a_port_that_is_taken_is_told_at_the_start() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(
            TelemetryError,
            match=rf"cannot be served on 127.0.0.1:{port}: .*in use; name another port",
        ):
            Run(port=port)


def test_an_address_of_another_machine_is_told_at_the_start() -> None:
    with pytest.raises(TelemetryError, match=r"cannot be served on 192\.0\.2\.1:0: "):
        Run(host="192.0.2.1")


def test_one_that_cannot_start_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("telemetry.metrics.process._MODULE", "telemetry.absent")
    with pytest.raises(TelemetryError, match="their process ended at once"):
        Run()


def test_one_that_does_not_end_is_ended(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("telemetry.metrics.process._END_S", 0.2)
    os.kill(run.metrics.pid, signal.SIGSTOP)
    run.metrics.close()
    assert run.metrics.trouble == "no metrics: their process ended with code -9"
