import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

from telemetry.segments import delete_oldest, incident_path, segment_path

NOON = datetime(2031, 5, 6, 12, tzinfo=UTC)


def wall_ns(at: datetime) -> int:
    return round(at.timestamp()) * 10**9 + 7_000_000


def segment(folder: Path, start: datetime, seconds: float) -> Path:
    path = segment_path(folder, "local", wall_ns(start))
    path.touch()
    end_s = start.timestamp() + seconds
    os.utime(path, (end_s, end_s))
    return path


def test_names_tell_time_site_and_reason(tmp_path: Path) -> None:
    assert segment_path(tmp_path, "local", wall_ns(NOON)).name == (
        "rows-20310506T120000.007Z-local.mcap"
    )
    assert incident_path(tmp_path, "remote", wall_ns(NOON), "fault").name == (
        "incident-20310506T120000.007Z-remote-fault.mcap"
    )


def test_the_newest_minutes_are_kept_however_old_and_every_incident(tmp_path: Path) -> None:
    minutes = [segment(tmp_path, NOON + timedelta(minutes=n), 60.0) for n in range(6)]
    short = [segment(tmp_path, NOON + timedelta(days=1, minutes=n), 10.0) for n in range(3)]
    incident = incident_path(tmp_path, "local", wall_ns(NOON), "died")
    incident.touch()
    other = tmp_path / "notes.txt"
    other.touch()
    delete_oldest(tmp_path, 130.0)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {path.name for path in (*minutes[-2:], *short, incident, other)}


def test_a_clock_that_was_set_deletes_nothing_too_soon(tmp_path: Path) -> None:
    paths = [segment(tmp_path, NOON + timedelta(minutes=n), -9e6) for n in range(5)]
    odd = tmp_path / "rows-99999999T999999.999Z-local.mcap"
    odd.touch()
    delete_oldest(tmp_path, 60.0)
    assert set(tmp_path.iterdir()) == {*paths, odd}
