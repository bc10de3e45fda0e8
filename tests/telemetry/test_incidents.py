import numpy as np

from telemetry.incidents import Incident, IncidentWatch
from telemetry.piece import Piece
from telemetry.row_ring import ARRIVAL, SiteEvent
from telemetry.rows import RowArray, row_dtype

MS = 1_000_000
READY, ENGAGED, FAULT, STOPPED = 1, 3, 6, 7
STATES = {FAULT: "FAULT", STOPPED: "EMERGENCY_STOP"}


def rows_of(states: list[tuple[int, int]]) -> RowArray:
    """Rows a millisecond apart: (state, how many) one after the other."""
    state = np.concatenate([np.full(count, number) for number, count in states])
    rows = np.zeros(len(state), row_dtype(2, 2))
    rows["state"] = state
    rows["sequence"] = np.arange(len(state))
    rows["stamp_ns"] = MS * np.arange(len(state))
    return rows


def arrivals_for(rows: RowArray) -> RowArray:
    arrivals = np.zeros(len(rows), ARRIVAL)
    arrivals["row"] = arrivals["number"] = rows["sequence"]
    return arrivals


def watched(
    rows: RowArray, events: tuple[SiteEvent, ...] = (), *, died: bool = False, piece: int = 20
) -> list[Incident]:
    watch = IncidentWatch(STATES)
    found = []
    for start in range(0, len(rows), piece):
        part = rows[start : start + piece]
        last_ns = part["stamp_ns"][-1]
        inside = tuple(e for e in events if last_ns - piece * MS < e.stamp_ns <= last_ns)
        incident = watch.observe(Piece(part, inside, arrivals_for(part)))
        found += [] if incident is None else [incident]
    return found + watch.end(died=died)


def test_five_seconds_before_and_one_after_are_kept() -> None:
    rows = rows_of([(READY, 3000), (ENGAGED, 6000), (FAULT, 5000)])
    events = tuple(SiteEvent(at * MS, str(at)) for at in (100, 3999, 4001, 9000, 9500))
    [incident] = watched(rows, events)
    assert (incident.why, incident.stamp_ns) == ("fault", 9000 * MS)
    assert incident.around.rows["sequence"].tolist() == list(range(4000, 10_001))
    assert incident.around.arrivals["row"].tolist() == list(range(4000, 10_001))
    assert [event.text for event in incident.around.events] == ["4001", "9000", "9500"]


def test_an_incident_within_a_second_belongs_to_the_first_a_later_one_is_its_own() -> None:
    states = [(ENGAGED, 100), (FAULT, 500), (STOPPED, 1000), (READY, 100), (STOPPED, 50)]
    incidents = watched(rows_of(states))
    assert [incident.why for incident in incidents] == ["fault", "emergency_stop"]
    assert incidents[1].around.rows["sequence"].tolist() == list(range(1750))


def test_a_site_that_died_keeps_its_last_five_seconds() -> None:
    rows = rows_of([(ENGAGED, 9000)])
    [incident] = watched(rows, died=True)
    assert incident.why == "died"
    assert incident.around.rows["sequence"].tolist() == list(range(3999, 9000))
    assert watched(rows) == []


def test_a_site_may_start_and_end_within_an_incident() -> None:
    incidents = watched(rows_of([(FAULT, 300)]), died=True)
    assert [incident.why for incident in incidents] == ["fault", "died"]
    assert all(len(incident.around.rows) == 300 for incident in incidents)
    assert IncidentWatch(STATES).end(died=True) == []
