"""The flight recorder, in a process of its own: `python -m telemetry.recorder`.

It reads what a site puts into shared memory, and writes it to the site's own disk. The
first line of its standard input tells what to do; when that input ends, the site has: the kernel
closes the other end however the site dies, and what the site had put is still in the memory.
"""

import json
import mmap
import platform
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Final, Self

import numpy as np

from telemetry.backlog import Backlog
from telemetry.companion import input_ended, stand_back
from telemetry.incidents import Incident, IncidentWatch
from telemetry.piece import NO_ARRIVALS, Piece
from telemetry.recording import RecordingSource, RecordingWriter
from telemetry.row_ring import RecorderStatus, RowRing, SiteEvent
from telemetry.rows import LAYOUT_VERSION, RowArray
from telemetry.segments import SEGMENT_S, delete_oldest, incident_path, segment_path
from telemetry.stream import FAREWELL

DRAIN_S: Final = 0.02
WRITE_S: Final = 0.03
RETRY_S: Final = 1.0
LAST_TRIES_S: Final = 5.0
"""How long a recorder whose site has ended goes on trying a disk that fails."""

PIECE_ROWS: Final = 1000
BACKLOG_BYTES: Final = 64 * 2**20

_PROGRAMS: Final = ("farhand", "numpy", "eclipse-zenoh", "pin", "mcap")
_MOST_INCIDENTS: Final = 16  # that wait for a disk that fails


@dataclass(frozen=True, slots=True)
class RecorderOptions:
    """What the site tells its recorder.

    `states` names all supervisor states by number, `incident_states` those whose entry is an
    incident. `session_files` are paths of what the session names, by key. Stamps and
    `wall_offset_ns` together are the wall clock as the run started.
    """

    folder: str
    keep_s: float
    session_name: str
    session_text: str
    session_files: Mapping[str, str]
    site: str
    wall_offset_ns: int
    states: Mapping[int, str]
    incident_states: tuple[str, ...]
    backlog_bytes: int = BACKLOG_BYTES

    def to_json(self) -> str:
        """Return the options as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Self:
        """Read what `to_json` wrote."""
        values = json.loads(line)
        values["states"] = {int(number): name for number, name in values["states"].items()}
        values["incident_states"] = tuple(values["incident_states"])
        return cls(**values)


def about_run(
    session_name: str, digest: int, epoch: int, states: Mapping[int, str]
) -> dict[str, str]:
    """Return what a recording tells of its run, and of the programs here."""
    return {
        "session": session_name,
        "digest": f"{digest:016x}",
        "epoch": str(epoch),
        "layout_version": str(LAYOUT_VERSION),
        "states": json.dumps(states),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{name: version(name) for name in _PROGRAMS},
    }


class Recorder:
    """One thread drains the ring into a backlog, another writes the backlog to the disk."""

    def __init__(self, ring: RowRing, options: RecorderOptions) -> None:
        layout = ring.layout
        self._ring = ring
        self._folder = Path(options.folder)
        self._keep_s = options.keep_s
        self._source = RecordingSource(
            options.site,
            layout.joints,
            layout.dimension,
            options.wall_offset_ns,
            options.session_text,
            about_run(options.session_name, layout.digest, layout.epoch, options.states),
            {key: Path(path).read_bytes() for key, path in options.session_files.items()},
        )
        self._watch = IncidentWatch(
            {n: name for n, name in options.states.items() if name in options.incident_states}
        )
        self._backlog = Backlog(options.backlog_bytes)
        self._next_row = 0
        self._next_event = 0
        self._next_arrival = 0
        self._said_farewell = False
        self._overwritten = 0
        self._unwritten = 0
        self._told_lost = 0
        self._written = 0
        self._failing = False
        self._error = ""
        self._segment: RecordingWriter | None = None
        self._segment_end_s = 0.0
        self._retry_s = 0.0
        self._incidents: deque[Incident] = deque(maxlen=_MOST_INCIDENTS)
        self._incidents_written = 0
        self._closing = threading.Event()
        self._writer = threading.Thread(target=self._write, name="writer", daemon=True)

    def start(self) -> None:
        """Open the first segment, so that a place that cannot be written to is told at once."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._open_segment()
        self._report()
        self._writer.start()

    def run(self, descriptor: int) -> None:
        """Record until this input ends, then all that is left."""
        while self._writer.is_alive() and not input_ended(descriptor, DRAIN_S):
            self.drain()
            self._report()
        self.finish()

    def drain(self) -> None:
        """Copy all that is new."""
        events, self._next_event = self._ring.events_from(self._next_event)
        self._said_farewell = self._said_farewell or any(e.text == FAREWELL for e in events)
        rows = self._ring.rows_from(self._next_row, PIECE_ROWS)
        self._take(Piece(rows, tuple(events), self._arrivals_for(rows)))
        while len(rows) == PIECE_ROWS:
            rows = self._ring.rows_from(self._next_row, PIECE_ROWS)
            self._take(Piece(rows, (), self._arrivals_for(rows)))

    def _arrivals_for(self, rows: RowArray) -> RowArray:
        """Take what arrived up to the last of these rows: it is there before the row is."""
        if not len(rows):
            return NO_ARRIVALS
        arrivals = self._ring.arrivals_from(self._next_arrival)
        last = rows["sequence"][-1]
        arrivals = arrivals[: np.searchsorted(arrivals["row"], last, side="right")]
        if len(arrivals):
            self._next_arrival = int(arrivals["number"][-1]) + 1
        return arrivals

    def finish(self) -> None:
        """Write all that is left of a site that has ended, and close the file."""
        self.drain()
        if not self._said_farewell:
            self._take(Piece(self._ring.rows[:0], (self._note("ended without farewell"),)))
        self._incidents.extend(self._watch.end(died=not self._said_farewell))
        self._closing.set()
        self._writer.join()
        self._report()

    def _take(self, piece: Piece) -> None:
        rows = piece.rows
        if len(rows):
            self._overwritten += int(rows["sequence"][0]) - self._next_row
            self._next_row = int(rows["sequence"][-1]) + 1
        elif not piece.events:
            return
        incident = self._watch.observe(piece)
        if incident is not None:
            self._incidents.append(incident)
        self._backlog.put(piece)

    @property
    def failed(self) -> bool:
        """Whether the disk failed to the end."""
        return self._failing

    @property
    def _lost(self) -> int:
        return self._overwritten + self._backlog.dropped + self._unwritten

    def _report(self) -> None:
        self._ring.status = RecorderStatus(
            not self._failing, self._written, self._lost, self._incidents_written, self._error
        )

    def _write(self) -> None:
        try:
            while not self._closing.wait(WRITE_S):
                self._write_all()
            give_up_s = time.monotonic() + LAST_TRIES_S
            while not self._write_all() and time.monotonic() < give_up_s:
                time.sleep(WRITE_S)
            self._give_up()
        except Exception as error:
            self._failing, self._error = True, f"{type(error).__name__}: {error}"

    def _write_all(self) -> bool:
        """Write what is there; whether nothing is left."""
        if self._failing and time.monotonic() < self._retry_s:
            return False
        while (piece := self._backlog.take(PIECE_ROWS)) is not None:
            try:
                self._write_piece(piece)
            except OSError as error:
                self._backlog.put_back(piece)
                self._fail(error)
                return False
            self._failing = False
            self._written += len(piece.rows)
        while self._incidents:
            incident = self._incidents.popleft()
            try:
                self._write_incident(incident)
            except OSError as error:
                self._incidents.appendleft(incident)
                self._fail(error)
                return False
            self._incidents_written += 1
        return True

    def _write_piece(self, piece: Piece) -> None:
        segment = self._segment
        if segment is not None and time.monotonic() >= self._segment_end_s:
            segment.close()
            self._segment = segment = None
        if segment is None:
            segment = self._open_segment()
        lost = self._lost
        if lost > self._told_lost:
            cause = self._error or "the recorder was held up"
            note = self._note(f"{lost - self._told_lost} rows lost: {cause}")
            piece = piece._replace(events=(note, *piece.events))
        segment.write(piece)
        segment.flush()
        self._told_lost = lost

    def _open_segment(self) -> RecordingWriter:
        self._folder.mkdir(parents=True, exist_ok=True)
        path = segment_path(self._folder, self._source.site, self._wall_ns(time.monotonic_ns()))
        self._segment = segment = RecordingWriter(path, self._source)
        self._segment_end_s = time.monotonic() + SEGMENT_S
        delete_oldest(self._folder, self._keep_s)
        return segment

    def _write_incident(self, incident: Incident) -> None:
        path = incident_path(
            self._folder, self._source.site, self._wall_ns(incident.stamp_ns), incident.why
        )
        path.unlink(missing_ok=True)  # what is left of a try before
        file = RecordingWriter(path, self._source)
        try:
            file.write(incident.around)
            file.close()
        except OSError:
            file.abandon()
            raise

    def _fail(self, error: OSError) -> None:
        """Let go of the file; a new segment is tried for in a second."""
        self._failing, self._error = True, str(error)
        self._retry_s = time.monotonic() + RETRY_S
        if self._segment is not None:
            self._segment.abandon()
            self._segment = None

    def _give_up(self) -> None:
        """Count what could not be written, close the file."""
        while (piece := self._backlog.take(PIECE_ROWS)) is not None:
            self._unwritten += len(piece.rows)
        if self._segment is not None:
            try:
                self._segment.close()
            except OSError as error:
                self._fail(error)

    def _wall_ns(self, stamp_ns: int) -> int:
        return stamp_ns + self._source.wall_offset_ns

    def _note(self, text: str) -> SiteEvent:
        return SiteEvent(time.monotonic_ns(), f"recorder: {text}")


def main() -> None:
    """Record the ring in the memory whose file descriptor is the first argument."""
    stand_back()
    ring = RowRing.attach(mmap.mmap(int(sys.argv[1]), 0))
    try:
        options = RecorderOptions.from_json(sys.stdin.readline())
        recorder = Recorder(ring, options)
        recorder.start()
        recorder.run(sys.stdin.fileno())
    except Exception as error:
        cause = str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        ring.status = replace(ring.status, recording=False, error=cause)
        sys.exit(1)
    sys.exit(recorder.failed)


if __name__ == "__main__":
    main()
