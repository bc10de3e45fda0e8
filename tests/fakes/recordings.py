"""Recordings of rows that a test has, as a flight recorder would have written them."""

import json
from collections.abc import Sequence
from pathlib import Path

from site_runtime.session import Session, named_files
from site_runtime.supervisor import State
from telemetry.piece import NO_ARRIVALS, Piece
from telemetry.recording import RecordingSource, RecordingWriter
from telemetry.row_ring import SiteEvent
from telemetry.rows import LAYOUT_VERSION, RowArray

WALL_OFFSET_NS = 1_764_000_000_000_000_000  # a clock that reads zero at 16:00:00 UTC
STATES = {state.value: state.name for state in State}


def record(
    path: Path,
    site: str,
    rows: RowArray,
    session: Session,
    *,
    epoch: int = 9,
    events: Sequence[SiteEvent] = (),
    arrivals: RowArray = NO_ARRIVALS,
    close: bool = True,
    wall_offset_ns: int = WALL_OFFSET_NS,
    **metadata: str,
) -> Path:
    """Write these rows, in chunks of 100, into a new file; left without an end if not to close."""
    path.parent.mkdir(parents=True, exist_ok=True)
    told = {
        "session": session.name,
        "digest": f"{session.digest:016x}",
        "epoch": str(epoch),
        "layout_version": str(LAYOUT_VERSION),
        "states": json.dumps({str(number): name for number, name in STATES.items()}),
        "farhand": "0.1.0",
        "python": "3.11.7",
    }
    shape = (rows["q"].shape[1], rows["position_m"].shape[1])
    files = {key: named.read_bytes() for key, named in named_files(session).items()}
    source = RecordingSource(site, *shape, wall_offset_ns, session.text, told | metadata, files)
    writer = RecordingWriter(path, source)
    writer.write(Piece(rows[:0], tuple(events), arrivals))
    for start in range(0, len(rows), 100):
        writer.write(Piece(rows[start : start + 100], ()))
        writer.flush()
    if close:
        writer.close()
    else:
        writer.abandon()
    return path
