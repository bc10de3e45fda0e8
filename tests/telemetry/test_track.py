"""Rows on the observer's timeline: held, taken once, and in between."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from telemetry.stream import Batch
from telemetry.track import HISTORY_NS, Track

MS = 1_000_000


def filled(run: Any, batches: int) -> Track:
    track = Track(2, 2)
    for batch, arrival_ns in run.batches():
        if batch.site == 0 and batches:
            track.add(batch, arrival_ns)
            batches -= 1
    track.merge(settled_only=False)
    return track


def test_rows_are_taken_once_and_forgotten_after_the_history(run: Any) -> None:
    track = filled(run, 200)
    assert len(track.rows) == 10_000
    newest_ns = track.newest_ns
    assert newest_ns is not None
    times_ns, rows = track.take(newest_ns - 100 * MS)
    assert rows.tobytes() == run.local[:9900].tobytes()
    track.forget()
    assert track.times_ns[0] == newest_ns - HISTORY_NS
    times_ns, rows = track.take(newest_ns)
    assert rows.tobytes() == run.local[9900:10_000].tobytes()
    assert np.array_equal(np.diff(times_ns), np.full(99, MS))
    assert not len(track.take(newest_ns)[1])


def test_what_was_given_out_outlasts_what_comes_after(run: Any) -> None:
    batches = [item for item in run.batches() if item[0].site == 0]
    track = Track(2, 2)
    taken = []
    for lap in range(3):  # more than there is room for
        for batch, arrival_ns in batches:
            later = arrival_ns + lap * 12_000 * MS
            rows = batch.rows.copy()
            rows["stamp_ns"] += lap * 12_000 * MS
            track.add(replace(batch, rows=rows), later)
            track.merge(settled_only=False)
            taken.append(track.take(later)[1])
            track.forget()
    assert [len(rows) for rows in taken] == [50] * 720
    assert np.array_equal(np.concatenate(taken)["q"], np.tile(run.local["q"], (3, 1)))
    assert len(track.rows) == HISTORY_NS // MS + 1


def test_rows_that_waited_long_find_room(run: Any) -> None:
    track = Track(2, 2)
    for batch, arrival_ns in run.batches(batch_rows=12_000):
        if batch.site == 0:
            for _ in range(3):
                track.add(batch, arrival_ns)
    track.merge(settled_only=False)
    assert len(track.rows) == 36_000


def test_a_new_run_is_told_from_the_old(run: Any) -> None:
    track = filled(run, 20)
    assert track.run_rows.tobytes() == run.local[:1000].tobytes()
    newest_ns = track.newest_ns
    assert newest_ns is not None
    again = Batch(0, 2, 2, 7, 2, run.local[:50])
    track.add(again, newest_ns + 4500 * MS)
    track.merge(settled_only=False)
    assert len(track.rows) == 1050
    assert track.run_rows.tobytes() == run.local[:50].tobytes()
    track.take(newest_ns + 10_000 * MS)
    track.forget()
    assert 50 < len(track.rows) < 1050
    assert track.run_rows.tobytes() == run.local[:50].tobytes()


def test_between_rows_motion_is_a_line_and_the_rest_stands(run: Any) -> None:
    track = filled(run, 20)
    times_ns = track.times_ns[100:200:10] + MS // 4
    rows = track.rows_at(times_ns)
    before, after = run.local[100:200:10], run.local[101:201:10]
    for name in ("q", "q_dot", "position_m", "velocity_m_s", "offset_m"):
        assert rows[name] == pytest.approx(0.75 * before[name] + 0.25 * after[name]), name
    assert np.array_equal(rows["external_force_n"], before["external_force_n"])
    assert np.array_equal(rows["sequence"], before["sequence"])
    assert np.array_equal(run.local["q"][:1000], track.rows["q"])  # a copy was changed


def test_what_is_told_is_the_position_without_the_offset(run: Any) -> None:
    rows = run.local[:100].copy()
    rows["offset_m"] = (0.1, -0.2)
    track = Track(2, 2)
    track.add(Batch(0, 2, 2, 7, 1, rows), int(rows["stamp_ns"][-1]))
    track.merge(settled_only=False)
    told_m = track.told_at(track.times_ns)
    assert told_m == pytest.approx(rows["position_m"] - (0.1, -0.2))
    assert np.isnan(track.told_at(track.times_ns[:1] - 1)).all()


def test_the_row_in_force_comes_with_its_time(run: Any) -> None:
    track = filled(run, 2)
    assert track.row_at(int(track.times_ns[0]) - 1) is None
    found = track.row_at(int(track.times_ns[30]) + MS - 1)
    assert found is not None
    time_ns, row = found
    assert (time_ns, row["sequence"]) == (track.times_ns[30], 30)
