"""Where the time goes between one hand and the other, as a table."""

from typing import Final

import numpy as np
import rerun as rr
from numpy.lib.recfunctions import repack_fields

from telemetry.dashboard.canvas import Canvas
from telemetry.latency import STAGES, sample_latencies, stage_percentiles_us
from telemetry.picture import Picture
from telemetry.rows import RowArray
from telemetry.track import Track

EVERY_NS: Final = 1_000_000_000
PERCENTS: Final = (50.0, 99.0)

_COLUMNS: Final = [
    *("stamp_ns", "read_ns", "step_ns", "write_ns", "sent_ns", "used_stamp_ns"),
    *("used_arrival_ns", "clock_offset_ns", "clock_uncertainty_ns"),
]


class LatencyPanel:
    """Writes once a second what each stage of a sample's way took in the last seconds."""

    def __init__(self, canvas: Canvas, picture: Picture, tracks: tuple[Track, Track]) -> None:
        self._canvas = canvas
        self._names = tuple(view.name for view in picture.sites)
        self._tracks = tracks
        self._written_ns: int | None = None

    def draw(self, until_ns: int) -> None:
        """Write it from the rows that the tracks hold, if it is time to."""
        if self._written_ns is not None and until_ns - self._written_ns < EVERY_NS:
            return
        self._written_ns = until_ns
        # Only what it takes: whole rows are ten times as long, and are copied on the way.
        local, remote = (repack_fields(track.run_rows[_COLUMNS]) for track in self._tracks)
        text = latency_text(self._names, local, remote)
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._canvas.log("latency", until_ns, document)


def latency_text(names: tuple[str, ...], local: RowArray, remote: RowArray) -> str:
    """Return the table in Markdown, from rows of one run of each site; median / p99 [ms]."""
    ways = [
        stage_percentiles_us(sample_latencies(sender, receiver), PERCENTS)
        for sender, receiver in ((local, remote), (remote, local))
    ]
    lines = [f"| stage | {names[0]} → {names[1]} | {names[1]} → {names[0]} |", "|:--|--:|--:|"]
    for stage in (*STAGES, "total"):
        cells = [" / ".join(map(_milliseconds, way[stage])) for way in ways]
        strong = "**" if stage == "total" else ""
        lines.append(
            "| " + " | ".join(f"{strong}{cell}{strong}" for cell in (stage, *cells)) + " |"
        )
    return "\n".join(lines)


def _milliseconds(microseconds: float) -> str:
    return f"{microseconds * 1e-3:.2f}" if np.isfinite(microseconds) else "–"
