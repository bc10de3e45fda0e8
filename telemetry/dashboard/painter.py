"""Turns batches of both sites into one rerun recording."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from rerun.sinks import LogSinkLike

from telemetry.dashboard.arms import SILENT_NS, Arms
from telemetry.dashboard.blueprint import blueprint
from telemetry.dashboard.canvas import Canvas
from telemetry.dashboard.certificate import CertificatePanel
from telemetry.dashboard.energies import Energies
from telemetry.dashboard.scene import draw_scene
from telemetry.dashboard.signals import Signals, common_style, draw_event, plot_apart
from telemetry.dashboard.stages import LatencyPanel
from telemetry.picture import Extent, Picture
from telemetry.rows import TelemetryError
from telemetry.stream import Batch
from telemetry.track import Track

Arrival = tuple[Batch, int]

ARRIVALS_AT_ONCE: Final = 4


class Painter:
    """Draws batches; belongs to one thread, and may block it."""

    def __init__(self, picture: Picture, sink: LogSinkLike) -> None:
        local, remote = picture.sites
        self._picture = picture
        self._extent = Extent(picture)
        self._tracks = tuple(Track(view.joints, view.dimension) for view in picture.sites)
        self._local, self._remote = tracks = (self._tracks[0], self._tracks[1])
        self._started = False
        self._canvas = canvas = Canvas(sink, blueprint(picture, self._extent))
        draw_scene(canvas, picture)
        self._signals = (
            Signals(canvas, picture, local, remote, limits=True),
            Signals(canvas, picture, remote, local, limits=False),
        )
        common_style(canvas)
        self._arms = Arms(canvas, picture, self._extent, tracks)
        self._certificate = CertificatePanel(canvas, picture)
        self._latency = LatencyPanel(canvas, picture, tracks)
        self._energies = (
            None if picture.meter is None else Energies(canvas, picture, picture.meter(), tracks)
        )

    @property
    def end_ns(self) -> int:
        """Time of the newest row on the timeline [ns]."""
        return max(track.newest_ns or 0 for track in self._tracks) - self._canvas.origin_ns

    def consume(self, items: Sequence[Arrival], last: bool) -> None:
        """Draw these (batch, arrival [ns]); if they are the last, end the recording."""
        for batch, arrival_ns in items:
            self._tracks[batch.site].add(batch, arrival_ns)
        self._draw(everything=last)
        if last:
            self._canvas.close()

    def _draw(self, *, everything: bool) -> None:
        for track in self._tracks:
            track.merge(settled_only=not everything)
        newest = [at_ns for track in self._tracks if (at_ns := track.newest_ns) is not None]
        if not newest:
            return
        if not self._started:
            self._start()
        # A site is drawn no further than its peer, for the peer is drawn into its picture; unless
        # the peer is silent.
        until_ns = max(newest)
        if not everything and len(newest) == 2 and until_ns - min(newest) < SILENT_NS:
            until_ns = min(newest)
        for track, signals in zip(self._tracks, self._signals, strict=True):
            times_ns, rows = track.take(until_ns)
            signals.draw(times_ns, rows, everything=everything)
            if track is self._local and len(rows):
                told_m = rows["position_m"] - rows["offset_m"]
                if len(self._remote.rows):
                    apart_m = np.linalg.norm(told_m - self._remote.told_at(times_ns), axis=1)
                    plot_apart(self._canvas, times_ns, apart_m)
        self._certificate.draw(until_ns, tuple(track.row_at(until_ns) for track in self._tracks))
        self._latency.draw(until_ns)
        if self._energies is not None:
            self._energies.draw(until_ns, everything=everything)
        if self._arms.draw(until_ns):
            self._canvas.show(blueprint(self._picture, self._extent))
        for track in self._tracks:
            track.forget()

    def _start(self) -> None:
        # The timeline shows the session's time, so that it can be read beside a result file.
        self._started = True
        track = next(track for track in self._tracks if len(track.rows))
        self._canvas.origin_ns = int(track.times_ns[0]) - int(track.rows["time_ns"][0])
        for text in self._arms.problems:
            draw_event(self._canvas, int(track.times_ns[0]), "WARN", text)


def check_shape(picture: Picture, batch: Batch) -> None:
    """Raise TelemetryError for a batch that is not of this picture's arms."""
    view = picture.sites[batch.site]
    if (batch.joints, batch.dimension) != (view.joints, view.dimension):
        raise TelemetryError(
            f"batch of {batch.joints} joints and {batch.dimension} task dimensions, but the "
            f"{view.name} arm has {view.joints} and {view.dimension}: is it of another session?"
        )


def paint(painter: Painter, picture: Picture, arrivals: Sequence[Arrival]) -> None:
    """Have a painter draw all of these, a few at a time as if they came live."""
    for batch, _ in arrivals:
        check_shape(picture, batch)
    for start in range(0, len(arrivals), ARRIVALS_AT_ONCE):
        painter.consume(arrivals[start : start + ARRIVALS_AT_ONCE], False)
    painter.consume([], True)
