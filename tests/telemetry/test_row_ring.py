import mmap
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from telemetry.row_ring import EVENT_CAPACITY, RecorderStatus, RingLayout, RowRing
from telemetry.rows import TelemetryError
from telemetry.stream import RING_BATCHES, TelemetryStream

ROOT = Path(__file__).parents[2]
LAYOUT = RingLayout(1, 3, 2, 10, 2**64 - 2, 2**63 + 5)


class Shared:
    """Memory of another process, as far as a ring can tell."""

    def __init__(self) -> None:
        self.memory = bytearray()

    def allocate(self, size: int) -> bytearray:
        self.memory = bytearray(size)
        return self.memory


@pytest.fixture
def shared() -> Shared:
    return Shared()


@pytest.fixture
def rings(shared: Shared) -> tuple[RowRing, RowRing]:
    """The writer's and the reader's."""
    writer = RowRing.create(LAYOUT, shared.allocate)
    return writer, RowRing.attach(shared.memory)


def put(ring: RowRing, *numbers: int) -> None:
    for number in numbers:
        ring.rows[number % ring.layout.capacity] = np.full((), number).astype(ring.rows.dtype)
        ring.count_row(number + 1)


def test_the_other_side_sees_the_layout_and_the_rows(rings: tuple[RowRing, RowRing]) -> None:
    writer, reader = rings
    assert reader.layout == LAYOUT
    put(writer, 0, 1, 2)
    rows = reader.rows_from(1, 100)
    assert rows["sequence"].tolist() == [1, 2]
    assert (rows["q"] == [[1.0] * 3, [2.0] * 3]).all()
    assert reader.rows_from(0, 2)["sequence"].tolist() == [0, 1]
    assert len(reader.rows_from(3, 100)) == 0


def test_a_row_that_is_not_counted_yet_is_not_seen(rings: tuple[RowRing, RowRing]) -> None:
    writer, reader = rings
    put(writer, 0)
    writer.rows[1]["sequence"] = 1
    assert reader.rows_from(0, 100)["sequence"].tolist() == [0]


def test_rows_that_may_be_overwritten_are_left_out(rings: tuple[RowRing, RowRing]) -> None:
    writer, reader = rings
    put(writer, *range(25))
    # the slot of row 15 is where row 25 is being written
    assert reader.rows_from(0, 100)["sequence"].tolist() == list(range(16, 25))


def test_rows_overwritten_while_they_are_copied_are_left_out(
    rings: tuple[RowRing, RowRing], monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, reader = rings
    put(writer, *range(10))
    arange = np.arange

    def late(start: int, end: int) -> np.ndarray:
        put(writer, 10, 11, 12)
        return arange(start, end)

    monkeypatch.setattr(np, "arange", late)
    rows = reader.rows_from(0, 100)
    assert rows["sequence"].tolist() == list(range(4, 10))


def test_events_are_seen_in_order_and_cut_to_whole_characters(
    rings: tuple[RowRing, RowRing],
) -> None:
    writer, reader = rings
    writer.put_event(5, "HOLD: the peer is silent")
    writer.put_event(-6, "é" * 119 + "abµ")
    writer.put_event(7, "lone \ud800")
    events, following = reader.events_from(0)
    assert events == [(5, "HOLD: the peer is silent"), (-6, "é" * 119 + "ab"), (7, "lone ?")]
    assert following == 3
    assert reader.events_from(3) == ([], 3)


def test_only_the_newest_events_are_kept(rings: tuple[RowRing, RowRing]) -> None:
    writer, reader = rings
    for number in range(EVENT_CAPACITY + 7):
        writer.put_event(number, str(number))
    events, following = reader.events_from(2)
    assert [event.stamp_ns for event in events] == list(range(8, EVENT_CAPACITY + 7))
    assert following == EVENT_CAPACITY + 7


def test_the_recorder_s_status_reaches_the_site(rings: tuple[RowRing, RowRing]) -> None:
    writer, reader = rings
    assert writer.status == RecorderStatus()
    reader.status = RecorderStatus(True, 5, 6, 7, "No space left on device")
    assert writer.status == RecorderStatus(True, 5, 6, 7, "No space left on device")
    reader.status = RecorderStatus(False)
    assert writer.status.error == ""


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [(0, 0, "starts with"), (8, 99, "layout 99"), (12, 255, "end within the rows")],
)
def test_other_memory_is_refused(shared: Shared, place: int, value: int, message: str) -> None:
    RowRing.create(LAYOUT, shared.allocate)
    shared.memory[place] = value
    with pytest.raises(TelemetryError, match=message):
        RowRing.attach(shared.memory)


def test_memory_too_small_for_anything_is_refused() -> None:
    with pytest.raises(TelemetryError, match="3 bytes"):
        RowRing.attach(bytearray(3))


def test_a_stream_counts_each_row_after_it_is_whole_and_passes_events(shared: Shared) -> None:
    stream = TelemetryStream(2, 2, 0, 7, 8, lambda _: None, 5, shared.allocate)
    reader = RowRing.attach(shared.memory)
    assert reader.layout == RingLayout(0, 2, 2, 5 * RING_BATCHES, 7, 8)
    stream.event(3, "READY")
    stream.farewell(4)
    assert reader.events_from(0)[0] == [(3, "READY"), (4, "farewell")]


WRITER = """
import mmap, sys
import numpy as np
from telemetry.row_ring import RowRing
ring = RowRing.attach(mmap.mmap(int(sys.argv[1]), 0))
number = 0
rows, capacity, dtype = ring.rows, ring.layout.capacity, ring.rows.dtype
fields = [rows[name] for name in dtype.names]
while True:
    for field in fields:  # one after the other, as a site does
        field[number % capacity] = number % 250
    rows["sequence"][number % capacity] = number
    number += 1
    ring.count_row(number)
"""


def test_what_is_read_beside_a_writer_is_never_torn_nor_after_its_sudden_death() -> None:
    descriptor = os.memfd_create("ring")

    def allocate(size: int) -> mmap.mmap:
        os.ftruncate(descriptor, size)
        return mmap.mmap(descriptor, size)

    ring = RowRing.create(RingLayout(1, 3, 2, 64, 1, 1), allocate)
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(descriptor)], pass_fds=[descriptor], cwd=ROOT
    )
    os.close(descriptor)
    try:
        following, seen, end_s = 0, 0, time.monotonic() + 30.0
        while seen < 20_000 and time.monotonic() < end_s:
            rows = ring.rows_from(following, 1000)
            if len(rows):
                assert rows["sequence"][0] >= following
                assert_whole(rows)
                following = int(rows["sequence"][-1]) + 1
                seen += len(rows)
        assert seen >= 20_000
    finally:
        writer.kill()
        writer.wait()
    rows = ring.rows_from(0, 1000)
    assert len(rows) == 63
    assert rows["sequence"][-1] == ring.row_count - 1
    assert_whole(rows)


def assert_whole(rows: np.ndarray) -> None:
    sequence = rows["sequence"].astype(np.int64)
    assert (np.diff(sequence) == 1).all()
    for name in rows.dtype.names or ():
        if name != "sequence":
            assert (sequence % 250 == rows[name].T).all(), name
