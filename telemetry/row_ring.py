"""The rows of one site in memory that other processes may read while they are written.

With them the packets that arrived, and events. One writer, the site; nobody waits for another. A
row is counted after it is whole, so a writer killed at any moment leaves no torn row to be read.
This, and reading while the other writes, relies on the order of stores that x86 keeps.
"""

import mmap
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple, Self, TypeAlias

import numpy as np

from telemetry.rows import LAYOUT_VERSION, RowArray, TelemetryError, row_dtype, row_struct

Memory: TypeAlias = bytearray | mmap.mmap

MAGIC: Final = b"FHRING01"
EVENT_BYTES: Final = 240
"""Longest text of an event, in UTF-8; the rest is cut off."""

EVENT_CAPACITY: Final = 256
ARRIVAL_BYTES: Final = 160
"""More than any packet has; the rest of a longer datagram is cut off."""

ARRIVAL_CAPACITY: Final = 32_768

# magic, layout version, site, joints, dimension, capacity, session digest, epoch
_HEADER: Final = struct.Struct("<8sBBBBIQQ")
_EVENT: Final = np.dtype([("stamp_ns", "<i8"), ("text", f"S{EVENT_BYTES}")])
ARRIVAL: Final = np.dtype(
    [("number", "<u8"), ("row", "<u8"), ("length", "<u4"), ("data", "u1", (ARRIVAL_BYTES,))],
    align=True,
)
"""A datagram that the link brought: how many came before, the row of its tick, its true length."""

_ARRIVAL: Final = struct.Struct(f"<QQI{ARRIVAL_BYTES}s4x")
_STATUS: Final = np.dtype(
    [
        ("recording", "<u8"),
        ("written", "<u8"),
        ("lost", "<u8"),
        ("incidents", "<u8"),
        ("error", f"S{EVENT_BYTES}"),
    ]
)
# Each on cache lines of its own: the site writes the counts, the recorder its status.
_COUNTS_AT: Final = 64
_STATUS_AT: Final = 128
_EVENTS_AT: Final = 512
_ARRIVALS_AT: Final = -(-(_EVENTS_AT + EVENT_CAPACITY * _EVENT.itemsize) // 4096) * 4096
_ROWS_AT: Final = -(-(_ARRIVALS_AT + ARRIVAL_CAPACITY * ARRIVAL.itemsize) // 4096) * 4096


class SiteEvent(NamedTuple):
    """What a site said of itself, at this time on its own clock."""

    stamp_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class RingLayout:
    """Whose rows a ring holds and how many."""

    site: int
    joints: int
    dimension: int
    capacity: int
    digest: int
    epoch: int


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """What the recorder says of itself: whether it can write now, and its last error.

    `written` counts rows on the disk, `lost` those that will never be there, `incidents` files.
    """

    recording: bool = False
    written: int = 0
    lost: int = 0
    incidents: int = 0
    error: str = ""


class RowRing:
    """Rings of rows, arrivals and events, and the recorder's status, in one piece of memory.

    The writer writes row n by `pack_row(places[n % capacity], ...)`, all numbers of its fields in
    order, or into `rows[n % capacity]`, and then calls `count_row`. In simulation, the memory is
    the process's own.
    """

    def __init__(self, layout: RingLayout, memory: Memory) -> None:
        dtype = row_dtype(layout.joints, layout.dimension)
        self.layout = layout
        self.rows: RowArray = np.frombuffer(memory, dtype, layout.capacity, _ROWS_AT)
        self.places = range(_ROWS_AT, _ROWS_AT + layout.capacity * dtype.itemsize, dtype.itemsize)
        # many times as fast as a field at a time; a method around it would cost half as much again
        self.pack_row = partial(row_struct(dtype).pack_into, memory)
        counts = memoryview(memory)[_COUNTS_AT : _COUNTS_AT + 24].cast("Q")
        self._counts = counts
        self._memory = memory
        self._arrivals: RowArray = np.frombuffer(memory, ARRIVAL, ARRIVAL_CAPACITY, _ARRIVALS_AT)
        events: RowArray = np.frombuffer(memory, _EVENT, EVENT_CAPACITY, _EVENTS_AT)
        self._event_stamp_ns = events["stamp_ns"]
        self._event_text = events["text"]
        self._status: Any = np.frombuffer(memory, _STATUS, 1, _STATUS_AT)

    @classmethod
    def create(cls, layout: RingLayout, allocate: Callable[[int], Memory] = bytearray) -> Self:
        """Make an empty ring; `allocate` gives zeroed memory of so many bytes."""
        memory = allocate(_ROWS_AT + layout.capacity * _row_bytes(layout))
        ring = cls(layout, memory)
        _HEADER.pack_into(
            memory,
            0,
            MAGIC,
            LAYOUT_VERSION,
            layout.site,
            layout.joints,
            layout.dimension,
            layout.capacity,
            layout.digest,
            layout.epoch,
        )
        return ring

    @classmethod
    def attach(cls, memory: Memory) -> Self:
        """Use a ring that another process made; TelemetryError if the memory holds none."""
        if len(memory) < _ROWS_AT:
            raise TelemetryError(f"{len(memory)} bytes of shared memory hold no ring of rows")
        magic, version, *numbers = _HEADER.unpack_from(memory)
        if (magic, version) != (MAGIC, LAYOUT_VERSION):
            raise TelemetryError(
                f"the shared memory starts with {magic!r}, layout {version}: expected {MAGIC!r}, "
                f"layout {LAYOUT_VERSION}"
            )
        layout = RingLayout(*numbers)
        if len(memory) < _ROWS_AT + layout.capacity * _row_bytes(layout):
            raise TelemetryError(f"{len(memory)} bytes of shared memory end within the rows")
        return cls(layout, memory)

    @property
    def row_count(self) -> int:
        """Rows written so far."""
        return self._counts[0]

    def count_row(self, count: int) -> None:
        """Let readers see all rows up to this many; real-time safe."""
        self._counts[0] = count

    def put_arrival(self, row: int, data: bytes) -> None:
        """Write a datagram that arrived for this row; real-time safe."""
        count = self._counts[2]
        at = _ARRIVALS_AT + count % ARRIVAL_CAPACITY * _ARRIVAL.size
        _ARRIVAL.pack_into(self._memory, at, count, row, len(data), data)
        self._counts[2] = count + 1

    def put_event(self, stamp_ns: int, text: str) -> None:
        """Write an event; real-time safe. Text beyond `EVENT_BYTES` is cut off."""
        count = self._counts[1]
        i = count % EVENT_CAPACITY
        self._event_stamp_ns[i] = stamp_ns
        self._event_text[i] = text.encode(errors="replace")
        self._counts[1] = count + 1

    def rows_from(self, first: int, most: int) -> RowArray:
        """Copy rows from number `first` on, in order; later ones if those are overwritten."""
        capacity = self.layout.capacity
        written = self.row_count
        start = max(first, written - capacity)
        rows = self.rows[np.arange(start, min(written, start + most)) % capacity]
        # One more than was counted meanwhile: the next row may be half written.
        overwritten = self.row_count - capacity + 1 - start
        return rows[max(overwritten, 0) :]

    def events_from(self, first: int) -> tuple[list[SiteEvent], int]:
        """Copy the events from number `first` on; also the number of the next one."""
        written = self._counts[1]
        start = max(first, written - EVENT_CAPACITY)
        events = [
            SiteEvent(
                int(self._event_stamp_ns[i % EVENT_CAPACITY]),
                _text(self._event_text[i % EVENT_CAPACITY]),
            )
            for i in range(start, written)
        ]
        overwritten = self._counts[1] - EVENT_CAPACITY + 1 - start
        return events[max(overwritten, 0) :], written

    def arrivals_from(self, first: int) -> RowArray:
        """Copy the arrivals, dtype `ARRIVAL`, from number `first` on; later ones if overwritten."""
        written = self._counts[2]
        start = max(first, written - ARRIVAL_CAPACITY)
        arrivals = self._arrivals[np.arange(start, written) % ARRIVAL_CAPACITY]
        overwritten = self._counts[2] - ARRIVAL_CAPACITY + 1 - start
        return arrivals[max(overwritten, 0) :]

    @property
    def status(self) -> RecorderStatus:
        """What the recorder last said."""
        recording, written, lost, incidents, error = self._status[0].item()
        return RecorderStatus(bool(recording), written, lost, incidents, _text(error))

    @status.setter
    def status(self, status: RecorderStatus) -> None:
        self._status[0] = (
            status.recording,
            status.written,
            status.lost,
            status.incidents,
            status.error.encode(errors="replace"),
        )


def _row_bytes(layout: RingLayout) -> int:
    return row_dtype(layout.joints, layout.dimension).itemsize


def _text(data: bytes) -> str:
    # A character cut in two at the end is left out.
    return data.decode(errors="ignore")
