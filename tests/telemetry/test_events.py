from typing import Any

import numpy as np
import pytest

from telemetry.events import Event, EventLog
from telemetry.rows import NO_PEER_STATE, RowArray, row_dtype

STATES = {
    0: "OFFLINE",
    1: "READY",
    2: "ENGAGED",
    3: "HOLD",
    4: "FAULT",
    5: "ALIGNING",
    6: "RELEASED",
    7: "EMERGENCY_STOP",
}
CUTS = {1: "torque", 4: "workspace"}
MS = 1_000_000


def rows_of(count: int, **fields: Any) -> RowArray:
    rows = np.zeros(count, row_dtype(2, 2))
    rows["peer_state"] = NO_PEER_STATE
    for name, values in fields.items():
        rows[name] = values
    return rows


def refused(count: int) -> list[int]:
    """So many packets refused, for two reasons."""
    return [count - 1, *([0] * 10), 1]


def observe(log: EventLog, start_ms: int, rows: RowArray) -> list[Event]:
    return log.observe((start_ms + np.arange(len(rows))) * MS, rows)


def new_log() -> EventLog:
    return EventLog("local", STATES, CUTS)


def test_a_state_is_told_when_it_changes_and_at_first() -> None:
    log = new_log()
    assert observe(log, 0, rows_of(4, state=[1, 1, 2, 3])) == [
        Event(0, "INFO", "local is READY"),
        Event(2 * MS, "INFO", "local is ENGAGED"),
        Event(3 * MS, "WARN", "local is HOLD"),
    ]
    assert observe(log, 4, rows_of(3, state=3)) == []
    assert observe(log, 7, rows_of(2, state=[4, 9])) == [
        Event(7 * MS, "ERROR", "local is FAULT"),
        Event(8 * MS, "INFO", "local is state 9"),
    ]


@pytest.mark.parametrize(
    ("before", "after", "level", "told"),
    [
        ({}, {"state": 5}, "WARN", "local is ALIGNING"),
        ({}, {"state": 6, "requests": 2}, "WARN", "local is RELEASED: the clutch is open"),
        ({}, {"state": 6, "requests": 1}, "WARN", "RELEASED: the device's clutch is open"),
        ({"requests": 4}, {"state": 7}, "ERROR", "EMERGENCY_STOP: its operator stopped it"),
        ({}, {"state": 7, "peer_state": 7}, "ERROR", "STOP: the peer is in emergency stop"),
        ({}, {"state": 7}, "ERROR", "local is EMERGENCY_STOP"),
        ({"state": 7, "requests": 8}, {"state": 1}, "INFO", "READY: its operator reset it"),
        ({"state": 4}, {"state": 1}, "INFO", "local is READY"),
        ({}, {"state": 3, "requests": 16}, "WARN", "local is HOLD: nobody here holds the lease"),
        ({"state": 3, "requests": 8}, {"state": 1}, "INFO", "local is READY"),
        ({}, {"state": 3, "peer_state": 4}, "WARN", "local is HOLD: the peer is FAULT"),
        (
            {},
            {"state": 3, "loop_bound_s": 0.45, "certified_round_trip_s": 0.4},
            "WARN",
            "local is HOLD: loop 450 ms, certified 400 ms",
        ),
        ({}, {"state": 3, "stamp_ns": 90 * MS}, "WARN", "its loop stood still for 90 ms"),
        ({}, {"state": 3}, "WARN", "local is HOLD"),
    ],
)
def test_a_cause_is_told_where_the_rows_show_it(
    before: dict[str, Any], after: dict[str, Any], level: str, told: str
) -> None:
    log = new_log()
    observe(log, 0, rows_of(1, **{"state": 2} | before))
    [event] = observe(log, 1, rows_of(1, **after))
    assert event.level == level
    assert event.text.endswith(told)


def test_a_peer_of_whom_nothing_new_comes_is_a_cause_of_hold() -> None:
    log = new_log()
    for start_ms in range(0, 300, 50):
        stamps_ms = start_ms + np.arange(50)
        rows = rows_of(50, state=np.where(stamps_ms < 260, 2, 3), stamp_ns=stamps_ms * MS)
        rows["used_stamp_ns"] = np.minimum(stamps_ms, 160) * MS
        told = observe(log, start_ms, rows)
    assert [event.text for event in told] == ["local is HOLD: nothing new of the peer for 100 ms"]


def test_counters_tell_what_came_since_and_not_what_was_before() -> None:
    log = new_log()
    first = observe(log, 0, rows_of(2, missed=40, rejected=refused(2), lost=7, late=1))
    assert [event.text for event in first] == ["local is OFFLINE"]
    rows = rows_of(2, missed=[40, 43], rejected=[refused(2), refused(3)], lost=[8, 9], late=[1, 2])
    assert observe(log, 2, rows) == [
        Event(3 * MS, "WARN", "local missed 3 ticks"),
        Event(3 * MS, "WARN", "local rejected 1 packets"),
        Event(3 * MS, "WARN", "local lost 2 packets of its peer"),
        Event(3 * MS, "WARN", "local got 1 packets too late"),
    ]


def test_a_flood_is_one_event_a_second() -> None:
    log = new_log()
    told = []
    for start_ms in range(0, 3000, 100):
        told += observe(log, start_ms, rows_of(100, lost=start_ms + np.arange(100)))
    assert [(event.time_ns // MS, event.text) for event in told[1:]] == [
        (99, "local lost 99 packets of its peer"),
        (1099, "local lost 1000 packets of its peer"),
        (2099, "local lost 1000 packets of its peer"),
    ]


def test_a_counter_set_to_zero_by_a_restart_is_no_event() -> None:
    log = new_log()
    observe(log, 0, rows_of(2, missed=40))
    assert observe(log, 2, rows_of(2, missed=0)) == []
    assert [e.text for e in observe(log, 2000, rows_of(2, missed=2))] == ["local missed 2 ticks"]


def test_guard_cuts_are_named_and_counted() -> None:
    log = new_log()
    assert observe(log, 0, rows_of(6, cut=[0, 1, 1, 5, 8, 0]))[1:] == [
        Event(
            5 * MS, "WARN", "local guard applied its limit on torque, workspace, bit 3 in 4 ticks"
        )
    ]
    assert observe(log, 6, rows_of(2, cut=1)) == []
    assert [e.text for e in observe(log, 1500, rows_of(2, cut=0))] == [
        "local guard applied its limit on torque in 2 ticks"
    ]


def test_no_rows_are_no_events() -> None:
    assert observe(new_log(), 0, rows_of(0)) == []
