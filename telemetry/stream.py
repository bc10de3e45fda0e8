"""From the control loop to the wire and back: a ring of rows, published in batches."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan
from typing import Final

import numpy as np
import numpy.typing as npt

from telemetry.row_ring import Memory, RingLayout, RowRing
from telemetry.rows import LAYOUT_VERSION, RowArray, TelemetryError, row_dtype

FloatArray = npt.NDArray[np.float64]

MAGIC: Final = b"FHTB"
MAX_BATCH_ROWS: Final = 10_000
RING_BATCHES: Final = 480  # at 1 kHz, 12 s for a recorder that is held up
_MOST: Final = 2**32 - 1  # that a counter's column holds
FAREWELL: Final = "farewell"
"""The last event of a site that ended in good order."""

# magic, layout version, site, joints, dimension, rows, session digest, epoch, first sequence
_HEADER: Final = struct.Struct("<4sBBBBIQQQ")


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive rows of one site; `rows` is read-only, of dtype `row_dtype(joints, dimension)`.

    `epoch` tells one run of a site from the next; `digest` is that of the session file.
    """

    site: int
    joints: int
    dimension: int
    digest: int
    epoch: int
    rows: RowArray


class TelemetryStream:
    """The producer's side: `put` in the tick, `flush` in the slack after it, one thread.

    A ring of 480 batches of rows is allocated once, by `allocate` if a recorder is to read it;
    `publish` gets each full batch as bytes and must not block. Rows overwritten before they were
    flushed are lost and counted.
    """

    def __init__(
        self,
        joints: int,
        dimension: int,
        site: int,
        session_digest: int,
        epoch: int,
        publish: Callable[[bytes], None],
        batch_rows: int = 25,
        allocate: Callable[[int], Memory] = bytearray,
    ) -> None:
        if not 1 <= batch_rows <= MAX_BATCH_ROWS:
            raise TelemetryError(f"batches of {batch_rows} rows; use 1 to {MAX_BATCH_ROWS}")
        if site not in (0, 1):
            raise TelemetryError(f"site {site}; use 0 (local) or 1 (remote)")
        for name, number in (("session digest", session_digest), ("epoch", epoch)):
            if not 0 <= number < 2**64:
                raise TelemetryError(f"{name} {number} does not fit into 64 bits")
        self._shape = (site, joints, dimension)
        self._session = (session_digest, epoch)
        self._publish = publish
        self._batch_rows = batch_rows
        # A whole number of batches, so that a full batch is always one piece of memory.
        self._capacity = RING_BATCHES * batch_rows
        self._count = 0
        self._flushed = 0
        self._batch_ends = batch_rows
        self._dropped = 0
        layout = RingLayout(site, joints, dimension, self._capacity, session_digest, epoch)
        self.ring = RowRing.create(layout, allocate)
        self._count_row, self._pack_row = self.ring.count_row, self.ring.pack_row
        self._places = self.ring.places
        self._ring = self.ring.rows

    @property
    def count(self) -> int:
        """Rows put so far; the sequence of the next row."""
        return self._count

    @property
    def dropped_rows(self) -> int:
        """Rows that were overwritten before `flush` was called often enough."""
        return self._dropped

    def put(
        self,
        stamp_ns: int,
        time_ns: int,
        lateness_ns: int,
        duration_ns: int,
        read_ns: int,
        step_ns: int,
        write_ns: int,
        sent_ns: int,
        state: int,
        peer_state: int,
        requests: int,
        cut: int,
        q: FloatArray,
        q_dot: FloatArray,
        torque_nm: FloatArray,
        position_m: FloatArray,
        velocity_m_s: FloatArray,
        external_force_n: FloatArray,
        coupling_force_n: FloatArray,
        peer_position_m: FloatArray,
        offset_m: FloatArray,
        force_share: float,
        engaged_s: float,
        used_stamp_ns: int,
        used_arrival_ns: int,
        clock_offset_ns: int,
        clock_uncertainty_ns: int,
        one_way_delay_s: float,
        round_trip_s: float,
        loop_bound_s: float,
        certified_round_trip_s: float,
        sub_task_error_rad_s: float,
        lost: int,
        late: int,
        rejected: Sequence[int],
        missed: int,
    ) -> None:
        """Write one row into the ring; real-time safe. Fields as in `COLUMNS`, in their order.

        By place, since forty names would take the tick another microsecond. Arrays are copied.
        What would not fit stays at the most that a column holds. A row whose assignment raises (a
        wrong shape) is not counted.
        """
        # _MOST is all ones: whatever is greater shows in any sum of bits
        if read_ns | step_ns | write_ns | sent_ns | lost | late | missed > _MOST:
            read_ns, step_ns, write_ns, sent_ns, lost, late, missed = (
                min(number, _MOST)
                for number in (read_ns, step_ns, write_ns, sent_ns, lost, late, missed)
            )
        count = self._count
        self._pack_row(
            self._places[count % self._capacity],
            count,
            stamp_ns,
            time_ns,
            lateness_ns,
            duration_ns,
            read_ns,
            step_ns,
            write_ns,
            sent_ns,
            state,
            peer_state,
            requests,
            cut,
            *q.tolist(),
            *q_dot.tolist(),
            *torque_nm.tolist(),
            *position_m.tolist(),
            *velocity_m_s.tolist(),
            *external_force_n.tolist(),
            *coupling_force_n.tolist(),
            *peer_position_m.tolist(),
            *offset_m.tolist(),
            force_share,
            engaged_s,
            used_stamp_ns,
            used_arrival_ns,
            clock_offset_ns,
            clock_uncertainty_ns,
            one_way_delay_s,
            round_trip_s,
            loop_bound_s,
            certified_round_trip_s,
            sub_task_error_rad_s,
            lost,
            late,
            *rejected,
            missed,
        )
        self._count = count + 1
        self._count_row(self._count)

    def repeat_stopped(
        self,
        *,
        stamp_ns: int,
        time_ns: int,
        lateness_ns: int,
        state: int,
        requests: int,
        read_ns: int = 0,
        step_ns: int = 0,
        reading: tuple[FloatArray, FloatArray, FloatArray] | None = None,
    ) -> None:
        """Write the newest row again for a site that no longer drives its device; real-time safe.

        Its outputs are off: no torque, no coupling, nothing cut. A tick that failed on the way
        tells how far it came, and its reading (q, q̇, external force). Without any row, there is
        nothing to repeat.
        """
        if self._count == 0:
            return
        i = self._count % self._capacity
        self._ring[i] = self._ring[(self._count - 1) % self._capacity]
        row = self._ring[i]
        row["sequence"] = self._count
        row["stamp_ns"] = stamp_ns
        row["time_ns"] = time_ns
        row["lateness_ns"] = lateness_ns
        row["read_ns"] = min(read_ns, _MOST)
        row["step_ns"] = min(step_ns, _MOST)
        row["write_ns"] = 0
        row["sent_ns"] = 0
        row["requests"] = requests
        row["state"] = state
        row["cut"] = 0
        if reading is not None:
            row["q"], row["q_dot"], row["external_force_n"] = reading
        row["torque_nm"] = 0.0
        row["coupling_force_n"] = 0.0
        row["force_share"] = 0.0
        row["engaged_s"] = nan
        self._count += 1
        self._count_row(self._count)

    def arrived(self, packets: Sequence[bytes]) -> None:
        """Tell the recorder what the link brought for the row to come; real-time safe."""
        put, row = self.ring.put_arrival, self._count
        for packet in packets:
            put(row, packet)

    def event(self, stamp_ns: int, text: str) -> None:
        """Tell the recorder what happened, in at most 240 bytes of UTF-8; real-time safe."""
        self.ring.put_event(stamp_ns, text)

    def farewell(self, stamp_ns: int) -> None:
        """Tell the recorder that the site ends in good order."""
        self.event(stamp_ns, FAREWELL)

    def flush(self) -> None:
        """Publish every full batch not yet published; nothing to do in most ticks."""
        while self._count >= self._batch_ends:
            self._publish_batch()

    def drain(self) -> None:
        """Publish all that is left, the last batch full or not; for the end of a session."""
        while self._count > self._flushed:
            self._publish_batch()

    def last(self, rows: int) -> RowArray:
        """Copy of the newest rows, oldest first; fewer if fewer are held."""
        end = self._count
        start = max(end - max(rows, 0), end - self._capacity, 0)
        return self._ring[np.arange(start, end) % self._capacity]

    def _forget_overwritten(self) -> None:
        oldest = self._count - self._capacity
        if self._flushed < oldest:
            self._dropped += oldest - self._flushed
            self._flushed = oldest

    def _publish_batch(self) -> None:
        self._forget_overwritten()
        # Up to the next multiple of the batch size, so never across the ring's end.
        rows = min(self._batch_rows - self._flushed % self._batch_rows, self._count - self._flushed)
        start = self._flushed % self._capacity
        header = _HEADER.pack(
            MAGIC, LAYOUT_VERSION, *self._shape, rows, *self._session, self._flushed
        )
        self._flushed += rows
        self._batch_ends = (self._flushed // self._batch_rows + 1) * self._batch_rows
        self._publish(header + self._ring[start : start + rows].tobytes())


def decode_batch(payload: bytes) -> Batch:
    """Read one published batch; TelemetryError for anything a `TelemetryStream` does not write.

    Whether its digest and epoch are those expected is for the caller to judge.
    """
    if len(payload) < _HEADER.size:
        raise TelemetryError(f"{len(payload)} bytes; a batch has a header of {_HEADER.size}")
    magic, version, site, joints, dimension, count, digest, epoch, first = _HEADER.unpack_from(
        payload
    )
    if magic != MAGIC:
        raise TelemetryError(f"starts with {magic!r}, not {MAGIC!r}: not a telemetry batch")
    if version != LAYOUT_VERSION:
        raise TelemetryError(
            f"layout version {version}, this program reads {LAYOUT_VERSION}: "
            "run the same version of farhand everywhere"
        )
    if site not in (0, 1):
        raise TelemetryError(f"site {site}, expected 0 (local) or 1 (remote)")
    if not 1 <= count <= MAX_BATCH_ROWS:
        raise TelemetryError(f"{count} rows, expected 1 to {MAX_BATCH_ROWS}")
    dtype = row_dtype(joints, dimension)
    expected = _HEADER.size + count * dtype.itemsize
    if len(payload) != expected:
        raise TelemetryError(
            f"{len(payload)} bytes, but {count} rows of {joints} joints and {dimension} task "
            f"dimensions take {expected}"
        )
    rows: RowArray = np.frombuffer(payload, dtype, offset=_HEADER.size)
    if first + count > 2**64 or not np.array_equal(
        rows["sequence"], np.uint64(first) + np.arange(count, dtype=np.uint64)
    ):
        raise TelemetryError(f"rows are not numbered consecutively from {first}")
    return Batch(site, joints, dimension, digest, epoch, rows)
