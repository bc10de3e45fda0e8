"""The energy of both sites as plots."""

from typing import Final

import numpy as np
import numpy.typing as npt

from telemetry.dashboard.canvas import Canvas
from telemetry.dashboard.signals import CALM_NS
from telemetry.dashboard.styles import Policy, series
from telemetry.energy import EnergyMeter
from telemetry.picture import WHITE, Picture, blend
from telemetry.track import Track

IntArray = npt.NDArray[np.int64]

STEP_NS: Final = 1_000_000
SILENT_NS: Final = 100_000_000
_PARTS: Final = {
    "kinetic": (160, 200, 120),
    "coupling": (200, 130, 200),
    "in transit": (90, 190, 190),
}


class Energies:
    """Gives a meter both sites' rows at the same instants, and draws what it says."""

    def __init__(
        self,
        canvas: Canvas,
        picture: Picture,
        meter: EnergyMeter,
        tracks: tuple[Track, Track],
    ) -> None:
        self._canvas = canvas
        self._meter = meter
        self._tracks = tracks
        self._names = [view.name for view in picture.sites]
        self._until_ns: int | None = None
        series(canvas, "energy/V", ["V"], [WHITE], Policy.Max, width=2.5)
        series(canvas, "energy/parts", list(_PARTS), list(_PARTS.values()))
        for view, by in zip(picture.sites, ("hand", "environment"), strict=True):
            names = [f"put in by the {by}", f"taken by {view.name} damping"]
            colours = [view.colour, blend(view.colour, WHITE, 0.6)]
            series(canvas, f"exchange/{view.name}", names, colours)

    def draw(self, until_ns: int, *, everything: bool) -> None:
        """Draw up to this time [ns], as far as both sites have been heard; maybe later."""
        if not all(len(track.rows) for track in self._tracks):
            return
        until_ns = min(until_ns, *(track.newest_ns or 0 for track in self._tracks))
        first_ns = max(int(track.times_ns[0]) for track in self._tracks)
        if self._until_ns is not None:
            first_ns = max(first_ns, self._until_ns + STEP_NS)
            if not everything and until_ns - first_ns < 0.95 * CALM_NS:
                return
        times_ns = np.arange(-(-first_ns // STEP_NS) * STEP_NS, until_ns + 1, STEP_NS)
        if not len(times_ns):
            return
        self._until_ns = int(times_ns[-1])
        for track in self._tracks:
            times_ns = times_ns[times_ns - track.times_ns[track.index_at(times_ns)] < SILENT_NS]
        local, remote = (track.rows_at(times_ns) for track in self._tracks)
        trace = self._meter.update(times_ns, local, remote)
        if not len(trace.times_ns):
            return
        self._canvas.plot("energy/V", trace.times_ns, trace.functional_j.sum(axis=1))
        self._canvas.plot("energy/parts", trace.times_ns, trace.functional_j)
        for site, name in enumerate(self._names):
            work_j = trace.injected_j[:, site], trace.dissipated_j[:, site]
            self._canvas.plot(f"exchange/{name}", trace.times_ns, *work_j)
