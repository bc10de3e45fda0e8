"""The runs that recordings on a disk hold: files and folders in, one recording a run out."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from telemetry.recording import Recording, joined, read_recording
from telemetry.rows import TelemetryError


def recording_files(paths: Iterable[Path]) -> list[Path]:
    """Return these files, and in place of each folder all segments below it, oldest first.

    TelemetryError for a folder without any.
    """
    files: list[Path] = []
    for path in paths:
        found = sorted(path.rglob("rows-*.mcap")) if path.is_dir() else [path]
        if not found:
            raise TelemetryError(f"{path}: there is no recording (rows-*.mcap) in this folder")
        files += found
    return files


def recorded_runs(files: Iterable[Path]) -> list[Recording]:
    """Join the segments of each run of each site, in the order of their first rows.

    A run without rows is left out; what several files hold, as an incident's, comes once.
    TelemetryError if a file is no recording, or two are by different recorders of one run.
    """
    segments: dict[tuple[str, str], list[Recording]] = {}
    for file in files:
        for site, recording in read_recording(file).items():
            run = segments.setdefault((site, recording.metadata["epoch"]), [])
            if run and run[0].metadata != recording.metadata:
                raise TelemetryError(
                    f"{file} is a second recording of a run: give those of one recorder"
                )
            run.append(recording)
    runs = [_whole(run) for run in segments.values()]
    return sorted((run for run in runs if len(run.rows)), key=lambda run: int(run.wall_times_ns[0]))


def _whole(segments: list[Recording]) -> Recording:
    """Join segments; of several, in the order of their rows and without what comes twice."""
    run = joined(segments)
    if len(segments) == 1 or np.all(np.diff(run.rows["sequence"].astype(np.int64)) > 0):
        return run
    _, rows = np.unique(run.rows["sequence"], return_index=True)
    _, arrivals = np.unique(run.arrivals["number"], return_index=True)
    events = sorted(dict.fromkeys(run.events), key=lambda event: event.stamp_ns)
    return replace(run, rows=run.rows[rows], events=tuple(events), arrivals=run.arrivals[arrivals])
