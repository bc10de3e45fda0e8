"""What a site says of itself, as lines for people and for programs."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from experiments.simulation import Simulation
from site_runtime.daemon_log import DaemonLog, LogFormat
from site_runtime.session import LoopSettings, load_session
from site_runtime.site import Site
from site_runtime.site_events import SiteEvents
from telemetry.row_ring import EVENT_CAPACITY

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
NOON_NS = 1_795_521_600_000_000_000  # 2026-11-24T12:00:00Z
EPOCH = 2**63 + 1


class Companion:
    trouble: str | None = None


@pytest.fixture
def site() -> Site:
    session = load_session(EXPERIMENTS / "theorem_b.toml")
    return Simulation(replace(session, loop=LoopSettings(100))).local


@pytest.fixture
def companion() -> Companion:
    return Companion()


def events_of(site: Site, log_format: LogFormat, *companions: Companion) -> SiteEvents:
    log = DaemonLog("local", log_format)
    log.about("theorem_b", EPOCH)
    return SiteEvents(site, companions, log, NOON_NS)


def told(capsys: pytest.CaptureFixture[str]) -> list[str]:
    captured = capsys.readouterr()
    assert captured.out == ""
    return captured.err.splitlines()


def told_json(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is no JSON")

    return [json.loads(line, parse_constant=refuse) for line in told(capsys)]


def test_a_line_for_each_event_once_with_its_own_time(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    events = events_of(site, LogFormat.TEXT)
    events.tell()
    assert told(capsys) == []
    site.telemetry.event(1_234_999_999, "HOLD: the peer is silent")
    site.telemetry.event(2_000_000_000, "farewell")
    events.tell()
    events.tell()
    assert told(capsys) == [
        "2026-11-24T12:00:01.234Z local  HOLD: the peer is silent",
        "2026-11-24T12:00:02.000Z local  HOLD: farewell",
    ]


@pytest.mark.parametrize(
    ("event", "level", "state", "text"),
    [
        ("ENGAGED: both sites agree", "INFO", "ENGAGED", "both sites agree"),
        ("HOLD: the peer is silent", "WARN", "HOLD", "the peer is silent"),
        ("FAULT: GuardError: [nan 0.] is: bad", "ERROR", "FAULT", "GuardError: [nan 0.] is: bad"),
        ("EMERGENCY_STOP: it was said", "ERROR", "EMERGENCY_STOP", "it was said"),
        ("de-rated: the loop is old", "WARN", "READY", "de-rated: the loop is old"),
        ("full gains: the loop is young", "INFO", "READY", "full gains: the loop is young"),
        ("farewell", "INFO", "READY", "farewell"),
        ('a "quoted" µ\nline', "INFO", "READY", 'a "quoted" µ\nline'),
    ],
)
def test_programs_get_one_object_a_line(
    site: Site,
    capsys: pytest.CaptureFixture[str],
    event: str,
    level: str,
    state: str,
    text: str,
) -> None:
    site.telemetry.event(5_000_000, event)
    site.round_trip_s, site.margin.certified_s, site.margin.loop_s = 0.125, 0.5, 0.25
    events_of(site, LogFormat.JSON).tell()
    assert told_json(capsys) == [
        {
            "time": "2026-11-24T12:00:00.005Z",
            "level": level,
            "site": "local",
            "session": "theorem_b",
            "epoch": str(EPOCH),
            "state": state,
            "text": text,
            "round_trip_s": 0.125,
            "margin_s": 0.25,
        }
    ]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_null(
    site: Site, capsys: pytest.CaptureFixture[str], value: float
) -> None:
    site.telemetry.event(0, "farewell")
    site.round_trip_s = site.margin.loop_s = value
    events_of(site, LogFormat.JSON).tell()
    [line] = told_json(capsys)
    assert line["round_trip_s"] is None
    assert line["margin_s"] is None


def test_events_that_came_too_fast_are_counted(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    events = events_of(site, LogFormat.JSON)
    for number in range(EVENT_CAPACITY + 9):
        site.telemetry.event(number, f"event {number}")
    events.tell()
    lines = told_json(capsys)
    # one more: the oldest might have been overwritten while it was read
    assert (lines[0]["level"], lines[0]["text"]) == (
        "WARN",
        "10 events of the site came too fast to be told",
    )
    assert [line["text"] for line in lines[1:]] == [
        f"event {number}" for number in range(10, EVENT_CAPACITY + 9)
    ]


def test_a_trouble_is_told_when_it_begins_ends_and_now_and_then(
    site: Site,
    companion: Companion,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = 100.0
    monkeypatch.setattr("site_runtime.site_events.time.monotonic", lambda: now_s)
    events = events_of(site, LogFormat.JSON, Companion(), companion)

    def tell(trouble: str | None) -> list[tuple[str, str]]:
        companion.trouble = trouble
        events.tell()
        return [(line["level"], line["text"]) for line in told_json(capsys)]

    assert tell(None) == []
    assert tell("5001 rows behind") == [("WARN", "5001 rows behind")]
    now_s += 0.5
    assert tell("5501 rows behind") == []
    now_s += 10.0
    assert tell("9501 rows behind") == [("WARN", "9501 rows behind")]
    now_s += 60.0
    assert tell("9501 rows behind") == []
    assert tell(None) == [("INFO", "over: 9501 rows behind")]
    assert tell("disk full") == [("WARN", "disk full")]


def test_what_concerns_no_site_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    log = DaemonLog("remote", LogFormat.JSON)
    log.say("[/no] such file", "ERROR")
    [line] = told_json(capsys)
    assert (line["level"], line["site"], line["text"]) == ("ERROR", "remote", "[/no] such file")
    assert (line["session"], line["epoch"], line["state"]) == (None, None, None)
    DaemonLog("remote").say("[/no] such file " + 30 * "and long ", "ERROR")
    [text] = told(capsys)
    assert text.startswith("[/no] such file and long")


def test_on_a_terminal_an_event_takes_the_live_line_s_place(
    site: Site, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    site.telemetry.event(0, "farewell")
    events_of(site, LogFormat.TEXT).tell()
    assert capsys.readouterr().err == ("\r\x1b[K2026-11-24T12:00:00.000Z local  READY: farewell\n")
