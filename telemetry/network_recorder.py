"""Records what both sites publish, off the network, in the format of their own flight recorders.

One thread offers batches, another writes them; `offer` never waits for the disk.
"""

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from telemetry.alignment import SiteClock
from telemetry.backlog import Backlog
from telemetry.piece import Piece
from telemetry.recorder import about_run
from telemetry.recording import Gap, RecordingSource, RecordingWriter
from telemetry.row_ring import SiteEvent
from telemetry.rows import RowArray
from telemetry.segments import SEGMENT_S, segment_path
from telemetry.stream import Batch
from telemetry.takes import SITES

WRITE_S: Final = 0.05
RETRY_S: Final = 1.0
LAST_TRIES_S: Final = 3.0
PIECE_ROWS: Final = 1000
BACKLOG_BYTES: Final = 64 * 2**20
MOST_RUNS: Final = 16
"""Of one session; who claims to have started more often is not recorded."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """What was recorded of one run of one site; `unwritten` rows came and found no disk."""

    site: str
    epoch: int
    rows: int
    gaps: tuple[Gap, ...]
    unwritten: int
    error: str


class NetworkRecorder:
    """Writes the rows of every run of both sites into a folder, in segments of a minute.

    Rows that never came, or that there was no room for, are gaps: an event in the recording, and a
    notice. `states` names the supervisor states by number.
    """

    def __init__(
        self,
        folder: Path,
        session_name: str,
        session_text: str,
        states: Mapping[int, str],
        backlog_bytes: int = BACKLOG_BYTES,
    ) -> None:
        self._folder = folder
        self._session_text = session_text
        self._session_name = session_name
        self._states = states
        self._backlog_bytes = backlog_bytes
        self._runs: dict[tuple[int, int, int, int], _Run] = {}
        self._notices: deque[str] = deque(maxlen=1000)
        self._closing = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._write, name="writer", daemon=True)
        self._thread.start()

    def offer(self, batch: Batch, arrival_ns: int) -> None:
        """Record one batch that arrived at this time [ns, this process' monotonic clock].

        Raises what ended the writer, if it was no failing disk.
        """
        if self._failure is not None:
            raise self._failure
        key = (batch.site, batch.epoch, batch.joints, batch.dimension)
        run = self._runs.get(key)
        if run is None:
            if len(self._runs) == MOST_RUNS:
                return
            run = _Run(self._folder, self._source(batch), self._backlog_bytes, self._notices)
            self._runs[key] = run
        run.offer(batch.rows, arrival_ns)

    def notices(self) -> list[str]:
        """Return what there is to tell since the last call."""
        return [self._notices.popleft() for _ in range(len(self._notices))]

    def close(self) -> list[Recorded]:
        """Write what is queued, close the files, and return what was recorded."""
        self._closing.set()
        self._thread.join()
        if self._failure is not None:
            raise self._failure
        return [run.recorded() for run in self._runs.values()]

    def _source(self, batch: Batch) -> RecordingSource:
        return RecordingSource(
            SITES[batch.site],
            batch.joints,
            batch.dimension,
            0,  # not known before some batches came
            self._session_text,
            about_run(self._session_name, batch.digest, batch.epoch, self._states)
            | {"source": "network"},
        )

    def _write(self) -> None:
        try:
            while not self._closing.wait(WRITE_S):
                for run in tuple(self._runs.values()):
                    run.write(closing=False)
            for run in self._runs.values():
                run.end()
        except Exception as error:
            self._failure = error


class _Run:
    """One run of one site: `offer` on one thread, all else on the writer's."""

    def __init__(
        self, folder: Path, source: RecordingSource, backlog_bytes: int, notices: deque[str]
    ) -> None:
        self._folder = folder
        self._source = source
        self._notices = notices
        self._clock = SiteClock()
        self._backlog = Backlog(backlog_bytes)
        self._next = 0
        self._segment: RecordingWriter | None = None
        self._segment_end_s = 0.0
        self._retry_s = 0.0
        self._error = ""
        self._newest: int | None = None
        self._rows = 0
        self._unwritten = 0
        self._gaps: list[Gap] = []

    def offer(self, rows: RowArray, arrival_ns: int) -> None:
        self._clock.observe(int(rows["stamp_ns"][-1]), arrival_ns)
        new = rows[rows["sequence"] >= self._next]  # what came twice, or too late, is in the file
        if len(new):
            self._next = int(new["sequence"][-1]) + 1
            self._backlog.put(Piece(new, ()))

    def write(self, *, closing: bool) -> bool:
        """Write what is there; whether nothing is left."""
        if not (self._clock.settled or closing) or time.monotonic() < self._retry_s:
            return False
        while (piece := self._backlog.take(PIECE_ROWS)) is not None:
            try:
                self._write_piece(piece)
            except OSError as error:
                self._backlog.put_back(piece)
                self._fail(error)
                return False
        return True

    def end(self) -> None:
        give_up_s = time.monotonic() + LAST_TRIES_S
        while not self.write(closing=True) and time.monotonic() < give_up_s:
            time.sleep(WRITE_S)
        while (piece := self._backlog.take(PIECE_ROWS)) is not None:
            self._unwritten += len(piece.rows)
        self._close_segment()

    def recorded(self) -> Recorded:
        source = self._source
        return Recorded(
            source.site,
            int(source.metadata["epoch"]),
            self._rows,
            tuple(self._gaps),
            self._backlog.dropped + self._unwritten,
            self._error,
        )

    def _write_piece(self, piece: Piece) -> None:
        if self._segment is not None and time.monotonic() >= self._segment_end_s:
            self._close_segment()
        segment = self._segment or self._open_segment()
        found = _gaps(piece.rows, self._newest)
        told = [f"{gap.rows} rows lost from row {gap.first} on" for gap, _ in found]
        events = tuple(
            SiteEvent(stamp_ns, f"recorder: {text}")
            for text, (_, stamp_ns) in zip(told, found, strict=True)
        )
        segment.write(piece._replace(events=events))
        segment.flush()
        if self._error:
            self._error = ""
            self._tell("recording again")
        self._rows += len(piece.rows)
        self._newest = int(piece.rows["sequence"][-1])
        self._gaps += [gap for gap, _ in found]
        for text in told:
            self._tell(text)

    def _open_segment(self) -> RecordingWriter:
        if not self._source.wall_offset_ns:
            # once for the run, so that its times are steady; from here on both sites share a clock
            wall_ns = time.time_ns() - time.monotonic_ns()
            offset_ns = wall_ns + self._clock.offset_ns
            self._source = replace(self._source, wall_offset_ns=offset_ns)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = segment_path(self._folder, self._source.site, time.time_ns())
        self._segment = segment = RecordingWriter(path, self._source)
        self._segment_end_s = time.monotonic() + SEGMENT_S
        return segment

    def _close_segment(self) -> None:
        """Close the file with its index; what cannot be indexed is readable all the same."""
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                segment.close()
            except OSError as error:
                segment.abandon()
                self._tell(f"a file was left without index: {error}")

    def _fail(self, error: OSError) -> None:
        if not self._error:
            self._tell(f"cannot write: {error}; trying again")
        self._error = str(error)
        self._retry_s = time.monotonic() + RETRY_S
        if self._segment is not None:
            self._segment.abandon()
            self._segment = None

    def _tell(self, text: str) -> None:
        self._notices.append(f"{self._source.site}: {text}")


def _gaps(rows: RowArray, newest: int | None) -> list[tuple[Gap, int]]:
    """Rows missing before and among these, each with the stamp of the row that came after."""
    sequence = rows["sequence"].astype(np.int64)
    before = np.concatenate(([sequence[0] - 1 if newest is None else newest], sequence[:-1]))
    return [
        (Gap(int(before[i]) + 1, int(sequence[i] - before[i]) - 1), int(rows["stamp_ns"][i]))
        for i in np.flatnonzero(sequence - before != 1)
    ]
