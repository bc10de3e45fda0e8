import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from channel.channel import Counters
from channel.packet import Reject
from experiments.simulation import Simulation
from site_runtime.daemon_log import DaemonLog
from site_runtime.guard import Cut
from site_runtime.session import LoopSettings, load_session
from site_runtime.site import Site
from site_runtime.site_events import SiteEvents
from site_runtime.status import StatusLine, describe, summary
from site_runtime.supervisor import State

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def new_simulation() -> Simulation:
    session = load_session(EXPERIMENTS / "theorem_b.toml")
    return Simulation(replace(session, loop=LoopSettings(100)))


@pytest.fixture(scope="module")
def site() -> Site:
    """A site that ran for a second, now offline."""
    simulation = new_simulation()
    simulation.run(1.0)
    return simulation.local


@pytest.fixture
def fresh() -> Site:
    return new_simulation().local


def printed(site: Site) -> str:
    console = Console(file=io.StringIO(), width=160)
    summary(site, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_line_says_state_rate_round_trip_margin_and_error(site: Site) -> None:
    line = describe(site, 99.7)
    row = site.telemetry.last(1)[0]
    error = np.linalg.norm(row["position_m"] - row["peer_position_m"])
    assert line.startswith("local  OFFLINE     100 Hz")
    assert f"round trip {site.round_trip_s * 1e3:6.1f} ms" in line
    assert f"margin {(site.margin.certified_s - site.margin.loop_s) * 1e3:6.1f} ms" in line
    assert f"error {error * 1e3:6.1f} mm" in line


def test_before_the_peer_is_there_no_number_is_shown(fresh: Site) -> None:
    line = describe(fresh, 100.0)
    assert "READY" in line
    for word in ("round trip", "margin", "error", "nan"):
        assert word not in line


def test_the_line_says_what_went_wrong(fresh: Site) -> None:
    fresh.failure = ArithmeticError("the controller broke")
    line = describe(fresh, 100.0)
    assert line.endswith("ArithmeticError: the controller broke")


def test_the_summary_counts_ticks_lateness_packets_and_cuts(fresh: Site) -> None:
    fresh.ticks, fresh.missed = 1234, 5
    for late_us in (10, 20, 30, 4000):
        fresh.lateness.add(late_us * 1000)
    fresh.channel.counters = Counters(sent=71, send_dropped=72, received=73, lost=74, late=75)
    fresh.channel.counters.rejected[Reject.DUPLICATE] = 76
    fresh.guard.counts[Cut.VELOCITY] = 77
    text = printed(fresh)
    assert "1234 run, 5 missed" in text
    assert "p50 20 · p99 4000 · p99.9 4000 · worst 4000 µs" in text
    assert "71 sent, 72 dropped here; 73 received, 74 lost, 75 late, 76 rejected" in text
    assert "76 duplicate" in text
    assert "velocity in 77 ticks" in text
    assert "torque" not in text
    assert "FAULT" not in text


def test_the_summary_names_the_fault(fresh: Site) -> None:
    fresh.failure = ArithmeticError("commanded torque [nan 0.] N·m [/is not] finite")
    fresh._supervisor.fault()
    text = printed(fresh)
    assert "FAULT" in text
    assert "ArithmeticError: commanded torque [nan 0.] N·m [/is not] finite" in text


def test_a_log_gets_whole_lines_and_the_thread_ends_with_the_context(
    fresh: Site, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("site_runtime.status.LOG_INTERVAL_S", 1e-3)
    line = StatusLine(fresh)
    with line:
        written = ""
        while written.count("\n") < 3:  # bounded by the test's own time limit
            written += capsys.readouterr().err
    assert not line._thread.is_alive()
    lines = written.splitlines()
    assert all(text.startswith("local  READY") for text in lines)


def test_a_site_that_is_not_watched_prints_nothing(
    fresh: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    with StatusLine(fresh, live=False) as line:
        assert not line._thread.is_alive()
    assert capsys.readouterr().err == ""


def test_events_are_told_to_the_last_without_a_live_line(
    fresh: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    events = SiteEvents(fresh, (), DaemonLog("local"), 0)
    with StatusLine(fresh, (), events, live=False):
        fresh.telemetry.farewell(0)  # long before the next look
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["1970-01-01T00:00:00.000Z local  READY: farewell"]


class TroubledRecorder:
    folder = "/state/[demo]/local"
    incidents = 2
    trouble = "not recording: [Errno 28] No space left on device, 7 rows not recorded"


def test_the_line_and_the_summary_say_what_the_recorder_could_not_do(fresh: Site) -> None:
    recorder: Any = TroubledRecorder()
    assert describe(fresh, 100.0, recorder).endswith(recorder.trouble)
    console = Console(file=io.StringIO(), width=160)
    summary(fresh, console, recorder)
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert recorder.trouble in text
    assert "2 kept in /state/[demo]/local" in text
    metrics: Any = TroubledRecorder()
    metrics.trouble = "no metrics"
    assert describe(fresh, 100.0, recorder, metrics).endswith(f"{recorder.trouble} · no metrics")
    recorder.trouble = None
    assert "record" not in describe(fresh, 100.0, recorder)


def test_the_line_warns_of_gains_that_are_de_rated(fresh: Site) -> None:
    fresh._supervisor.state = State.ENGAGED
    assert "DE-RATED" not in describe(fresh, 100.0)
    fresh._supervisor._scale = 0.6
    assert "DE-RATED to 60%" in describe(fresh, 100.0)
    fresh._supervisor.state = State.READY
    assert "DE-RATED" not in describe(fresh, 100.0)
