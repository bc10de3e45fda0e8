"""The runs that recordings on a disk hold: files and folders in, one recording a run out."""

from collections.abc import Iterable
from pathlib import Path

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

    A run without rows is left out. TelemetryError if a file is no recording, or two are by
    different recorders of one run.
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
    runs = [joined(sorted(run, key=_first_row)) for run in segments.values()]
    return sorted((run for run in runs if len(run.rows)), key=lambda run: int(run.wall_times_ns[0]))


def _first_row(segment: Recording) -> int:
    return int(segment.rows["sequence"][0]) if len(segment.rows) else -1
