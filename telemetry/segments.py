"""The folder of one site's recordings: segments by their start, the oldest deleted, incidents kept.

`rows-<UTC>-<site>.mcap` are segments, `incident-<UTC>-<site>-<why>.mcap` incidents.
"""

import re
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

SEGMENT_S: Final = 60.0

_START: Final = re.compile(r"rows-(\d{8}T\d{6}\.\d{3})Z-")
_FORMAT: Final = "%Y%m%dT%H%M%S.%f"
_SHORTEST_S: Final = 1.0


def segment_path(folder: Path, site: str, wall_ns: int) -> Path:
    """Where a segment goes that starts at this time on the wall clock."""
    return folder / f"rows-{_utc(wall_ns)}-{site}.mcap"


def incident_path(folder: Path, site: str, wall_ns: int, why: str) -> Path:
    """Where an incident of this time on the wall clock goes."""
    return folder / f"incident-{_utc(wall_ns)}-{site}-{why}.mcap"


def delete_oldest(folder: Path, keep_s: float) -> None:
    """Keep the newest segments that last `keep_s` together, whichever run they are of.

    A pause between two runs does not count. Incidents are never deleted.
    """
    kept_s = 0.0
    for path in sorted(folder.glob("rows-*.mcap"), reverse=True):
        if kept_s > keep_s:
            with suppress(OSError):
                path.unlink()
        else:
            kept_s += _duration_s(path)


def _duration_s(path: Path) -> float:
    """From the start in its name to its last change; a wall clock that was set is not trusted."""
    started = _START.match(path.name)
    if started is None:
        return 0.0
    try:
        start_s = datetime.strptime(started[1], _FORMAT).replace(tzinfo=UTC).timestamp()
        return min(max(path.stat().st_mtime - start_s, _SHORTEST_S), SEGMENT_S)
    except (OSError, ValueError):
        return 0.0


def _utc(wall_ns: int) -> str:
    at = datetime.fromtimestamp(wall_ns // 1_000_000 / 1e3, UTC)
    return at.strftime(_FORMAT)[:-3] + "Z"
