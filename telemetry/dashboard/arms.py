"""Both arms as they move: links, joints, trail, forces, and the peer as it was one delay ago."""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rerun as rr

from telemetry.dashboard.canvas import Canvas
from telemetry.dashboard.robot_mesh import RobotMesh
from telemetry.dashboard.styles import shapes
from telemetry.picture import BACKGROUND, GREY, RED, WHITE, Extent, Picture, SiteView, blend, home
from telemetry.rows import RowArray
from telemetry.track import HISTORY_NS, Track

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FRAME_NS: Final = 33_333_333
TRAIL_FRAMES: Final = 90
SILENT_NS: Final = 500_000_000


class Arms:
    """Draws both arms at thirty frames a second; `tracks` are those of local and remote."""

    def __init__(
        self, canvas: Canvas, picture: Picture, extent: Extent, tracks: tuple[Track, Track]
    ) -> None:
        self._extent = extent
        self._frame: int | None = None
        self._canvas = canvas
        local, remote = (
            _Arm(canvas, picture, view, track)
            for view, track in zip(picture.sites, tracks, strict=True)
        )
        self._pairs = ((local, remote), (remote, local))
        for arm, peer in self._pairs:
            arm.log_style(peer.view)

    @property
    def problems(self) -> list[str]:
        """What of the robots' descriptions cannot be drawn, in words."""
        return [text for arm, _ in self._pairs for text in arm.problems]

    def draw(self, until_ns: int) -> bool:
        """Draw the frames up to this time [ns]; whether the views have to show more room."""
        origin_ns = self._canvas.origin_ns
        last = (until_ns - origin_ns) // FRAME_NS
        if self._frame is None:
            starts_ns = [
                int(arm.track.times_ns[0]) for arm, _ in self._pairs if len(arm.track.rows)
            ]
            self._frame = (min(starts_ns, default=until_ns) - origin_ns) // FRAME_NS
        # Older frames than the history cannot be drawn.
        first = max(self._frame, last - HISTORY_NS // FRAME_NS)
        self._frame = max(self._frame, last + 1)
        times_ns = np.arange(first, last + 1, dtype=np.int64) * FRAME_NS + origin_ns
        grown = False
        for arm, peer in self._pairs:
            index = arm.track.index_at(times_ns)
            # A site that has fallen silent keeps its last picture.
            seen = index >= 0
            seen[seen] = times_ns[seen] - arm.track.times_ns[index[seen]] < SILENT_NS
            if seen.any():
                rows = arm.track.rows[index[seen]]
                points_m = arm.view.chain(rows["q"])
                grown |= self._extent.include(points_m)
                arm.draw(peer, times_ns[seen], rows, points_m)
        return grown


class _Arm:
    """One site's arm, in its own view."""

    def __init__(self, canvas: Canvas, picture: Picture, view: SiteView, track: Track) -> None:
        self.view = view
        self.track = track
        self._canvas = canvas
        self._picture = picture
        self._shapes = shapes(picture)
        self._trail_m: FloatArray = np.empty((0, 3))
        self._mesh = None if view.urdf is None else RobotMesh(canvas, view, view.urdf)

    @property
    def problems(self) -> list[str]:
        return [] if self._mesh is None else self._mesh.problems

    def log_style(self, peer: SiteView) -> None:
        view, width = self.view, self._picture.reach_m / 55
        # Inside a mesh, lines only show through where it is missing.
        line = 0.4 * width if self._mesh is not None else width

        def log(path: str, archetype: type[Any], order: int, style: dict[str, Any]) -> None:
            if not self._picture.spatial:
                style["draw_order"] = order
            self._canvas.log_static(f"scene/{view.name}/{path}", archetype.from_fields(**style))

        strips, points, arrows = self._shapes
        ghost = blend(peer.colour, BACKGROUND, 0.55)
        pale = blend(view.colour, WHITE, 0.5)
        log("ghost", strips, 10, {"colors": ghost, "radii": 0.7 * width})
        trail = blend(view.colour, BACKGROUND, 0.3)
        log("trail", strips, 15, {"colors": trail, "radii": 0.25 * width})
        log("arm", strips, 20, {"colors": view.colour, "radii": line})
        log("joints", points, 30, {"colors": WHITE, "radii": 1.4 * line})
        log("forces", arrows, 40, {"colors": [pale, RED], "radii": 0.4 * width})
        base = {"positions": self._picture.place(home(view)), "colors": GREY, "radii": 2.4 * line}
        log("base", points, 25, base)

    def draw(self, peer: "_Arm", times_ns: IntArray, rows: RowArray, points_m: FloatArray) -> None:
        place = self._picture.place
        strips, points, arrows = self._shapes

        def send(path: str, columns: Iterable[rr.ComponentColumn]) -> None:
            self._canvas.send(f"scene/{self.view.name}/{path}", times_ns, columns)

        send("arm", strips.columns(strips=list(place(points_m))))
        centers = place(points_m[:, 1:])
        positions = points.columns(positions=np.concatenate(list(centers)))
        send("joints", positions.partition([centers.shape[1]] * len(centers)))
        tips_m = points_m[:, -1]
        trail_m = np.concatenate((self._trail_m, tips_m))
        ends = range(len(self._trail_m) + 1, len(trail_m) + 1)
        trails = [place(trail_m[max(end - TRAIL_FRAMES, 0) : end]) for end in ends]
        send("trail", strips.columns(strips=trails))
        self._trail_m = trail_m[-TRAIL_FRAMES:]
        vectors = np.stack(
            [self._picture.arrows(rows[f"{name}_force_n"]) for name in ("coupling", "external")],
            axis=1,
        )
        both = arrows.columns(
            origins=np.repeat(place(tips_m), 2, axis=0), vectors=np.concatenate(list(vectors))
        )
        send("forces", both.partition([2] * len(rows)))
        lengths, ghosts = self._ghosts(peer, times_ns, rows["one_way_delay_s"])
        send("ghost", strips.columns(strips=list(ghosts)).partition(lengths))
        if self._mesh is not None:
            self._mesh.draw(times_ns, rows["q"])

    def _ghosts(
        self, peer: "_Arm", times_ns: IntArray, delays_s: FloatArray
    ) -> tuple[list[int], FloatArray]:
        """Return the peer's arm as it was one delay ago: the one this site is coupled to.

        One length a frame, 0 or 1: where it is not known, an empty drawing takes the last away.
        """
        known = np.isfinite(delays_s)
        then_ns = times_ns - (np.where(known, delays_s, 0.0) * 1e9).astype(np.int64)
        index = peer.track.index_at(then_ns)
        known &= index >= 0
        chains = peer.view.chain(peer.track.rows[index[known]]["q"])
        return known.astype(int).tolist(), self._picture.place(chains)
