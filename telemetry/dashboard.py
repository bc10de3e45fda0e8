"""The dashboard: both sites' rows as one live picture, in a process of its own.

The only module that imports rerun. A viewer that stalls blocks whoever logs to it, so every sink
has a pump: a queue that drops the oldest batches, and one thread that makes all rerun calls.
"""

import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient
from rerun.sinks import LogSinkLike

from telemetry.events import EventLog
from telemetry.picture import (
    BACKGROUND,
    GREY,
    RED,
    WHITE,
    Colour,
    Extent,
    Picture,
    SiteView,
    blend,
    circle,
    home,
    wall_lines,
)
from telemetry.pump import CAPACITY, Pump
from telemetry.rows import RowArray, TelemetryError
from telemetry.stream import Batch
from telemetry.track import HISTORY_NS, Track

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Arrival = tuple[Batch, int]
Log = Callable[[str, rr.AsComponents], None]
Send = Callable[[str, Iterable[rr.ComponentColumn]], None]
Policy = rr.components.AggregationPolicy

APPLICATION: Final = "farhand"
TIMELINE: Final = "t"
WINDOW_S: Final = 10.0
FRAME_NS: Final = 33_333_333
TRAIL_FRAMES: Final = 90
RESTATE_NS: Final = 5_000_000_000
SILENT_NS: Final = 500_000_000
SERVER_MEMORY: Final = "64MiB"
FLUSH_S: Final = 60.0
VIEWER_DEADLINE_S: Final = 60.0
NOTICE_S: Final = 5.0
"""Notices of its start cover a corner of the viewer for no longer than this."""
ARRIVALS_AT_ONCE: Final = 4

_STATE_COLOURS: Final[dict[str, Colour]] = {
    "OFFLINE": (92, 92, 92),
    "READY": (84, 110, 168),
    "ENGAGED": (64, 160, 84),
    "HOLD": (201, 162, 39),
    "FAULT": (208, 62, 62),
}


@dataclass(frozen=True, slots=True)
class LiveServer:
    """Serves the picture on loopback, to viewers that come and go; see `start_viewer`."""

    port: int = 9876

    @property
    def address(self) -> str:
        """What a viewer connects to."""
        return f"rerun+http://127.0.0.1:{self.port}/proxy"


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """Saves the picture as a file (.rrd) that `rerun FILE` opens."""

    path: Path


Sink = LiveServer | RecordingFile


class Dashboard:
    """Shows batches of both sites on every sink; `offer` never blocks."""

    def __init__(
        self, picture: Picture, sinks: Sequence[Sink], queue_batches: int = CAPACITY
    ) -> None:
        self._picture = picture
        self._pumps = [
            Pump(f"dashboard {sink}", _painter(picture, sink).consume, queue_batches)
            for sink in sinks
        ]

    @property
    def dropped_batches(self) -> int:
        """Batches not shown because a sink was not fast enough."""
        return sum(pump.dropped for pump in self._pumps)

    @property
    def waiting_batches(self) -> int:
        """Batches offered that the slowest sink has not taken up yet."""
        return max((pump.waiting for pump in self._pumps), default=0)

    def stalled_s(self) -> float:
        """How long the slowest sink has been blocked [s]; a health signal."""
        return max((pump.stalled_s() for pump in self._pumps), default=0.0)

    def offer(self, batch: Batch, arrival_ns: int) -> None:
        """Show one batch that arrived at this time [ns, this process' monotonic clock].

        Safe from any thread. TelemetryError if the batch is not of this picture's arms, or a sink
        failed.
        """
        _check_shape(self._picture, batch)
        for pump in self._pumps:
            pump.offer((batch, arrival_ns))

    def close(self, timeout_s: float = 5.0) -> bool:
        """Show what is queued and end every sink; False if one is blocked for longer and left."""
        ended = [pump.close(timeout_s) for pump in self._pumps]
        return all(ended)


def _check_shape(picture: Picture, batch: Batch) -> None:
    view = picture.sites[batch.site]
    if (batch.joints, batch.dimension) != (view.joints, view.dimension):
        raise TelemetryError(
            f"batch of {batch.joints} joints and {batch.dimension} task dimensions, but the "
            f"{view.name} arm has {view.joints} and {view.dimension}: is it of another session?"
        )


def _painter(picture: Picture, sink: Sink) -> "Painter":
    if isinstance(sink, RecordingFile):
        try:
            return Painter(picture, rr.FileSink(sink.path))
        except RuntimeError as error:
            raise TelemetryError(f"cannot write the recording {sink.path}: {error}") from error
    # rerun itself would only log that the port is taken, and serve nothing.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", sink.port))
        except OSError as error:
            raise TelemetryError(
                f"cannot serve the dashboard on port {sink.port}: {error.strerror}; "
                "is another one running? Choose another port"
            ) from error
    server = rr.GrpcServerSink("127.0.0.1", sink.port, server_memory_limit=SERVER_MEMORY)
    return Painter(picture, server)


# Drawing ----------------------------------------------------------------------------------------


class _Site:
    """One site as it is drawn: its rows, and what was last said about it."""

    def __init__(self, view: SiteView, picture: Picture) -> None:
        self.view = view
        self.track = Track(view.joints, view.dimension)
        self.events = EventLog(view.name, picture.state_names, picture.cut_names)
        self.state: int | None = None
        self.stated_ns = 0
        self.trail_m: FloatArray = np.empty((0, 3))


class Painter:
    """Turns batches into one rerun recording; belongs to one thread, and may block it."""

    def __init__(self, picture: Picture, sink: LogSinkLike) -> None:
        self._picture = picture
        self._sites = tuple(_Site(view, picture) for view in picture.sites)
        self._local, self._remote = self._sites
        self._extent = Extent(picture)
        self._started = False
        self._origin_ns = 0
        self._frame = 0
        self._strips: Any = rr.LineStrips3D if picture.spatial else rr.LineStrips2D
        self._points: Any = rr.Points3D if picture.spatial else rr.Points2D
        self._arrows: Any = rr.Arrows3D if picture.spatial else rr.Arrows2D
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.set_sinks(sink, default_blueprint=_blueprint(picture, self._extent))
        self._log_scene()
        for site, peer in (self._sites, self._sites[::-1]):
            self._log_arm_style(site.view, peer.view)
            self._log_series_style(site.view, peer.view)

    @property
    def end_ns(self) -> int:
        """Time of the newest row on the timeline [ns]."""
        return max(site.track.newest_ns or 0 for site in self._sites) - self._origin_ns

    def consume(self, items: Sequence[Arrival], last: bool) -> None:
        """Draw these (batch, arrival [ns]); if they are the last, end the recording."""
        for batch, arrival_ns in items:
            self._sites[batch.site].track.add(batch, arrival_ns)
        self._draw(everything=last)
        if last:
            self._recording.flush(timeout_sec=FLUSH_S)
            self._recording.disconnect()

    def _draw(self, *, everything: bool) -> None:
        tracks = [site.track for site in self._sites]
        for track in tracks:
            track.merge(settled_only=not everything)
        newest = [time_ns for track in tracks if (time_ns := track.newest_ns) is not None]
        if not newest:
            return
        if not self._started:
            self._started = True
            self._set_origin(next(track for track in tracks if len(track.rows)))
        # A site is drawn no further than its peer, for the peer is drawn into its picture; unless
        # the peer is silent.
        until_ns = max(newest)
        if not everything and len(newest) == 2 and until_ns - min(newest) < SILENT_NS:
            until_ns = min(newest)
        for site in self._sites:
            times_ns, rows = site.track.take(until_ns)
            if len(rows):
                self._draw_signals(site, times_ns, rows)
        self._draw_arms(until_ns)
        for track in tracks:
            track.forget()

    def _set_origin(self, track: Track) -> None:
        # The timeline shows the session's time, so that it can be read beside a result file.
        first_ns = int(track.rows["time_ns"][0])
        self._origin_ns = int(track.times_ns[0]) - first_ns
        self._frame = first_ns // FRAME_NS

    def _time_column(self, times_ns: IntArray) -> rr.TimeColumn:
        return rr.TimeColumn(
            TIMELINE, duration=(times_ns - self._origin_ns).astype("timedelta64[ns]")
        )

    def _log_at(self, time_ns: int, path: str, what: rr.AsComponents) -> None:
        duration = np.timedelta64(time_ns - self._origin_ns, "ns")
        self._recording.set_time(TIMELINE, duration=duration)
        self._recording.log(path, what)

    def _log_static(self, path: str, what: rr.AsComponents) -> None:
        self._recording.log(path, what, static=True)

    # Signals

    def _draw_signals(self, site: _Site, times_ns: IntArray, rows: RowArray) -> None:
        time_column, name = self._time_column(times_ns), site.view.name

        def send(path: str, *series: FloatArray) -> None:
            scalars = rr.Scalars.columns(scalars=np.column_stack(series))
            self._recording.send_columns(f"{path}/{name}", [time_column], scalars)

        send("error", np.linalg.norm(rows["position_m"] - rows["peer_position_m"], axis=1) * 1e3)
        external_n = np.linalg.norm(rows["external_force_n"], axis=1)
        send("force", external_n, np.linalg.norm(rows["coupling_force_n"], axis=1))
        send("torque", rows["torque_nm"])
        send("delay", rows["one_way_delay_s"] * 1e3)
        send("round_trip", rows["loop_bound_s"] * 1e3)
        send("lateness", rows["lateness_ns"] * 1e-3)
        send("angle", rows["q"])
        send("speed", rows["q_dot"])
        if self._picture.scene.obstacles:
            send("clearance", rows["link_distance_m"] * 1e3)
        if site is self._local:
            self._send_finite(
                "round_trip/certified", times_ns, rows["certified_round_trip_s"] * 1e3
            )
            if len(self._remote.track.rows):
                told_m = rows["position_m"] - rows["offset_m"]
                apart_m = told_m - self._remote.track.position_at(times_ns)
                self._send_finite("error/apart", times_ns, np.linalg.norm(apart_m, axis=1) * 1e3)
        self._log_states(site, times_ns, rows)
        for time_ns, level, text in site.events.observe(times_ns, rows):
            stamped = f"{(time_ns - self._origin_ns) * 1e-9:8.3f} s  {text}"
            self._log_at(time_ns, "events", rr.TextLog(stamped, level=level))

    def _send_finite(self, path: str, times_ns: IntArray, values: FloatArray) -> None:
        finite = np.isfinite(values)
        if finite.any():
            scalars = rr.Scalars.columns(scalars=values[finite])
            self._recording.send_columns(path, [self._time_column(times_ns[finite])], scalars)

    def _log_states(self, site: _Site, times_ns: IntArray, rows: RowArray) -> None:
        for time_ns, state in zip(times_ns.tolist(), rows["state"].tolist(), strict=True):
            # Said again although unchanged: a viewer that comes late has lost what is older.
            if state != site.state or time_ns - site.stated_ns >= RESTATE_NS:
                site.state, site.stated_ns = state, time_ns
                self._log_at(time_ns, f"state/{site.view.name}", rr.StateChange(state=str(state)))

    # Arms

    def _draw_arms(self, until_ns: int) -> None:
        last = (until_ns - self._origin_ns) // FRAME_NS
        # Older frames than the history cannot be drawn.
        first = max(self._frame, last - HISTORY_NS // FRAME_NS)
        self._frame = max(self._frame, last + 1)
        times_ns = np.arange(first, last + 1, dtype=np.int64) * FRAME_NS + self._origin_ns
        grown = False
        for site, peer in (self._sites, self._sites[::-1]):
            index = site.track.index_at(times_ns)
            # A site that has fallen silent keeps its last picture.
            seen = index >= 0
            seen[seen] = times_ns[seen] - site.track.times_ns[index[seen]] < SILENT_NS
            if seen.any():
                rows = site.track.rows[index[seen]]
                points_m = site.view.chain(rows["q"])
                grown |= self._extent.include(points_m)
                self._draw_arm(site, peer, times_ns[seen], rows, points_m)
        if grown:
            self._recording.send_blueprint(_blueprint(self._picture, self._extent))

    def _draw_arm(
        self, site: _Site, peer: _Site, times_ns: IntArray, rows: RowArray, points_m: FloatArray
    ) -> None:
        place, root = self._picture.place, f"scene/{site.view.name}"
        time_column = [self._time_column(times_ns)]

        def send(path: str, columns: Iterable[rr.ComponentColumn]) -> None:
            self._recording.send_columns(f"{root}/{path}", time_column, columns)

        send("arm", self._strips.columns(strips=list(place(points_m))))
        centers = place(points_m[:, 1:])
        positions = self._points.columns(positions=np.concatenate(list(centers)))
        send("joints", positions.partition([centers.shape[1]] * len(centers)))
        tips_m = points_m[:, -1]
        trail_m = np.concatenate((site.trail_m, tips_m))
        ends = range(len(site.trail_m) + 1, len(trail_m) + 1)
        trails = [place(trail_m[max(end - TRAIL_FRAMES, 0) : end]) for end in ends]
        send("trail", self._strips.columns(strips=trails))
        site.trail_m = trail_m[-TRAIL_FRAMES:]
        for path in ("external_force", "coupling_force"):
            vectors = self._picture.arrows(rows[f"{path}_n"])
            send(path, self._arrows.columns(origins=place(tips_m), vectors=vectors))
        self._draw_ghost(peer, times_ns, rows["one_way_delay_s"], send)

    def _draw_ghost(
        self, peer: _Site, times_ns: IntArray, delays_s: FloatArray, send: Send
    ) -> None:
        """Draw the peer's arm as it was one delay ago: the one this site is coupled to."""
        known = np.isfinite(delays_s)
        then_ns = times_ns - (np.where(known, delays_s, 0.0) * 1e9).astype(np.int64)
        index = peer.track.index_at(then_ns)
        known &= index >= 0
        # Where it is not known, an empty drawing takes the last one away.
        points = self._picture.place(peer.view.chain(peer.track.rows[index[known]]["q"]))
        lengths = known.astype(int).tolist()
        send("ghost", self._strips.columns(strips=list(points)).partition(lengths))
        send("ghost_name", self._points.columns(positions=points[:, 1]).partition(lengths))

    # Styles, and what never changes

    def _log_scene(self) -> None:
        picture, width = self._picture, self._picture.reach_m / 90
        obstacles = picture.scene.obstacles
        if obstacles:
            centers = [obstacle.center_m for obstacle in obstacles]
            names = [obstacle.name for obstacle in obstacles]
            faint = blend(RED, BACKGROUND, 0.35)
            if picture.spatial:
                solid: Any = rr.Ellipsoids3D(
                    centers=centers,
                    radii=[obstacle.collision_radius_m for obstacle in obstacles],
                    colors=RED,
                    fill_mode="solid",
                )
                safe: Any = rr.Ellipsoids3D(
                    centers=centers,
                    radii=[obstacle.safe_radius_m for obstacle in obstacles],
                    colors=faint,
                    line_radii=0.2 * width,
                )
            else:
                solid = rr.LineStrips2D(
                    [circle(np.array(o.center_m), o.collision_radius_m) for o in obstacles],
                    colors=RED,
                    radii=width,
                )
                safe = rr.LineStrips2D(
                    [circle(np.array(o.center_m), o.safe_radius_m) for o in obstacles],
                    colors=faint,
                    radii=0.3 * width,
                )
            self._log_static("scene/world/obstacles", solid)
            self._log_static("scene/world/safe", safe)
            # A name is written below its point: below the obstacle, then.
            feet = [np.array(o.center_m) - (0.0, o.safe_radius_m, 0.0) for o in obstacles]
            positions = picture.place(np.array(centers if picture.spatial else feet))
            self._log_static(
                "scene/world/names",
                self._points(positions, colors=RED, radii=0.2 * width, labels=names),
            )
        lines = [
            line
            for wall in picture.scene.walls
            for line in wall_lines(wall, picture.reach_m, spatial=picture.spatial)
        ]
        if lines:
            faint = blend(RED, BACKGROUND, 0.5 if picture.spatial else 0.25)
            radius = (0.15 if picture.spatial else 0.4) * width
            self._log_static("scene/world/walls", self._strips(lines, colors=faint, radii=radius))
        if not picture.spatial:
            # The viewer's y axis points down in two dimensions; the robots' points up.
            up = rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])
            self._log_static("scene", up)

    def _log_arm_style(self, view: SiteView, peer: SiteView) -> None:
        width = self._picture.reach_m / 55

        def log(path: str, archetype: type[Any], order: int, style: dict[str, Any]) -> None:
            if not self._picture.spatial:
                style["draw_order"] = order
            self._log_static(f"scene/{view.name}/{path}", archetype.from_fields(**style))

        ghost = blend(peer.colour, BACKGROUND, 0.55)
        pale = blend(view.colour, WHITE, 0.5)
        name = {"colors": ghost, "radii": 0.4 * width, "labels": f"{peer.name} (delayed)"}
        log("ghost", self._strips, 10, {"colors": ghost, "radii": 0.7 * width})
        log("ghost_name", self._points, 11, name)
        trail = blend(view.colour, BACKGROUND, 0.3)
        log("trail", self._strips, 15, {"colors": trail, "radii": 0.25 * width})
        log("arm", self._strips, 20, {"colors": view.colour, "radii": width})
        log("joints", self._points, 30, {"colors": WHITE, "radii": 1.4 * width})
        log("coupling_force", self._arrows, 40, {"colors": pale, "radii": 0.4 * width})
        log("external_force", self._arrows, 41, {"colors": RED, "radii": 0.4 * width})
        base = {"positions": self._picture.place(home(view)), "colors": GREY, "radii": 2.4 * width}
        log("base", self._points, 25, base)

    def _log_series_style(self, view: SiteView, peer: SiteView) -> None:
        def log(path: str, names: list[str], colours: list[Colour], how: Policy | None) -> None:
            style = rr.SeriesLines(names=names, colors=colours, widths=1.5, aggregation_policy=how)
            self._log_static(path, style)

        def log_joints(path: str, symbol: str) -> None:
            count, own = view.joints, view.colour
            names = [f"{view.name} {symbol}{i}" for i in range(1, count + 1)]
            shades = [blend(own, WHITE, 0.75 * i / max(count - 1, 1)) for i in range(count)]
            log(f"{path}/{view.name}", names, shades, None)

        own, pale = view.colour, blend(view.colour, WHITE, 0.6)
        log(f"error/{view.name}", [f"{view.name} to delayed {peer.name}"], [own], None)
        log(
            f"force/{view.name}",
            [f"{view.name} external", f"{view.name} coupling"],
            [own, pale],
            None,
        )
        log_joints("torque", "τ")
        log_joints("angle", "q")
        log_joints("speed", "q̇")
        # One pixel holds many ticks: show the worst of them, not their mean.
        log(f"delay/{view.name}", [f"{peer.name} → {view.name}"], [peer.colour], Policy.Max)
        log(f"round_trip/{view.name}", [f"seen by {view.name}"], [own], Policy.Max)
        log(f"lateness/{view.name}", [view.name], [own], Policy.Max)
        log(f"clearance/{view.name}", [f"{view.name} links"], [own], Policy.Min)
        log("error/apart", ["|local − remote|"], [WHITE], None)
        log("round_trip/certified", ["certified"], [RED], None)
        names = self._picture.state_names
        states = rr.StateConfiguration(
            values=[str(state) for state in names],
            labels=list(names.values()),
            colors=[_STATE_COLOURS.get(name, GREY) for name in names.values()],
        )
        self._log_static(f"state/{view.name}", states)


def _blueprint(picture: Picture, extent: Extent) -> rrb.Blueprint:
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S)
    end = rrb.TimeRangeBoundary.cursor_relative()
    # The range limits what is queried; the axis, what is seen: both, or the axis breathes.
    time_range = rrb.VisibleTimeRange(TIMELINE, start=start, end=end)
    time_axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end), zoom_lock=True)

    def plot(path: str, name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=f"/{path}",
            name=name,
            axis_x=time_axis,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
            time_ranges=[time_range],
        )

    def arm(view: SiteView) -> rrb.View:
        name = f"{view.name.capitalize()} · {view.joints} joints"
        contents = ["/scene/world/**", f"/scene/{view.name}/**"]
        low, high = extent.low, extent.high
        if picture.spatial:
            center = (low + high) / 2
            eye = center + picture.reach_m * np.array([-0.5, -1.3, 0.8])
            return rrb.Spatial3DView(
                contents=contents,
                name=name,
                background=BACKGROUND,
                eye_controls=rrb.EyeControls3D(position=eye, look_target=center, eye_up=(0, 0, 1)),
            )
        bounds = rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1]))
        return rrb.Spatial2DView(
            contents=contents, name=name, background=BACKGROUND, visual_bounds=bounds
        )

    events = rrb.TextLogView(
        origin="/events",
        name="Events",
        columns=rrb.TextLogColumns(
            # Too narrow for its times, which the text has instead.
            timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
        format_options=rrb.TextLogFormat(monospace_body=True),
    )
    tabs = [events, plot("angle", "Joint angles [rad]"), plot("speed", "Joint speeds [rad/s]")]
    if picture.scene.obstacles:
        tabs.append(plot("clearance", "Clearance [mm]"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Horizontal(*(arm(view) for view in picture.sites)),
                rrb.StateTimelineView(origin="/state", name="Supervisor", time_view=time_axis),
                rrb.Tabs(*tabs, active_tab=0),
                row_shares=[5, 1.4, 2],
            ),
            rrb.Vertical(
                plot("error", "Position error [mm]"),
                plot("force", "Force [N]"),
                plot("torque", "Joint torque [N·m]"),
            ),
            rrb.Vertical(
                plot("delay", "One-way delay [ms]"),
                plot("round_trip", "Greatest loop age [ms]"),
                plot("lateness", "Loop lateness [µs]"),
            ),
            column_shares=[5, 3, 3],
        ),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
    )


# Viewers ----------------------------------------------------------------------------------------


class ViewerCrashError(TelemetryError):
    """A headless viewer was ended by a signal, as drivers in software sometimes do: try again."""


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer started as a child process; `address` is its window's name or its web page."""

    process: subprocess.Popen[bytes]
    address: str

    def close(self) -> None:
        """End the viewer."""
        _end(self.process)


def start_viewer(live: LiveServer, web_port: int = 9090) -> Viewer:
    """Start a viewer of a live dashboard: a window if there is a display, else a web page.

    The page is served on loopback only; over a network, forward both ports through ssh.
    """
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        arguments = ["--port", str(_free_port()), "--hide-welcome-screen", live.address]
        return Viewer(_start_rerun(arguments), "window")
    arguments = ["--serve-web", "--web-viewer-port", str(web_port), live.address]
    viewer = Viewer(
        _start_rerun(arguments),
        f"http://127.0.0.1:{web_port}/?url={live.address.replace('+', '%2B')}",
    )
    _wait_for_port(web_port, viewer.process)
    return viewer


def screenshot(
    path: Path,
    picture: Picture,
    arrivals: Sequence[Arrival],
    width: int = 1920,
    height: int = 1080,
) -> None:
    """Draw these (batch, arrival [ns]) into a PNG file, as the dashboard looks after the last.

    Uses a viewer without a window, which needs a Vulkan driver; one in software will do.
    TelemetryError if the viewer cannot be started or does not draw.
    """
    try:
        _screenshot(path, picture, arrivals, width, height)
    except ViewerCrashError:
        _screenshot(path, picture, arrivals, width, height)


def _screenshot(
    path: Path, picture: Picture, arrivals: Sequence[Arrival], width: int, height: int
) -> None:
    with headless_viewer(width, height) as client:
        draw(client, picture, arrivals)
        _wait_until_still(client, NOTICE_S)
        client.save_screenshot(str(path))


@contextmanager
def headless_viewer(width: int = 1920, height: int = 1080) -> Iterator[ViewerClient]:
    """Run a viewer without a window, on loopback, for as long as the context lasts."""
    port = _free_port()
    size = ["--headless", "--window-size", f"{width}x{height}", "--hide-welcome-screen"]
    process = _start_rerun(["--port", str(port), *size])
    try:
        _wait_for_port(port, process)
        yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
    except Exception as error:
        if (process.poll() or 0) < 0:
            raise ViewerCrashError(
                f"the viewer was ended by signal {-process.returncode}"
            ) from error
        raise
    finally:
        _end(process)


def draw(client: ViewerClient, picture: Picture, arrivals: Sequence[Arrival]) -> None:
    """Have this viewer show these (batch, arrival [ns]), and wait until it does."""
    painter = Painter(picture, rr.GrpcSink(client.url))
    paint(painter, picture, arrivals)
    deadline = time.monotonic() + VIEWER_DEADLINE_S
    while not any(
        timeline.name == TIMELINE and (timeline.end or 0) >= painter.end_ns
        for recording in client.get_state().recordings
        for timeline in recording.timelines
    ):
        _pause(deadline, "did not receive the recording")
    client.set_time(TIMELINE, duration=painter.end_ns * 1e-9, play_state="paused")
    _wait_until_still(client, 0.0)


def save_recording(path: Path, picture: Picture, arrivals: Sequence[Arrival]) -> None:
    """Draw these (batch, arrival [ns]) into a file (.rrd), dropping none; TelemetryError."""
    paint(_painter(picture, RecordingFile(path)), picture, arrivals)


def paint(painter: Painter, picture: Picture, arrivals: Sequence[Arrival]) -> None:
    """Have a painter draw all of these, a few at a time as if they came live."""
    for batch, _ in arrivals:
        _check_shape(picture, batch)
    for start in range(0, len(arrivals), ARRIVALS_AT_ONCE):
        painter.consume(arrivals[start : start + ARRIVALS_AT_ONCE], False)
    painter.consume([], True)


def _wait_until_still(client: ViewerClient, still_s: float) -> None:
    deadline = time.monotonic() + VIEWER_DEADLINE_S
    shot, since = client.take_screenshot(), time.monotonic()
    while True:
        _pause(deadline, "did not come to rest")
        last, shot = shot, client.take_screenshot()
        if shot != last:
            since = time.monotonic()
        elif time.monotonic() - since >= still_s:
            return


def _pause(deadline: float, failure: str) -> None:
    if time.monotonic() > deadline:
        raise TelemetryError(f"the viewer {failure} within {VIEWER_DEADLINE_S:.0f} s")
    time.sleep(0.2)


def _start_rerun(arguments: list[str]) -> subprocess.Popen[bytes]:
    # The binary itself, not its Python launcher: ending the launcher would leave a viewer behind.
    binary = str(files("rerun_cli") / "rerun")
    return subprocess.Popen(  # noqa: S603
        [binary, "--bind", "127.0.0.1", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"RERUN_APP_ONLY": "true"},
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _wait_for_port(port: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + VIEWER_DEADLINE_S
    while True:
        if process.poll() is not None:
            raise TelemetryError(
                f"the viewer ended at once with code {process.returncode}: is a graphics driver "
                "installed (Debian: mesa-vulkan-drivers), and is the port free?"
            )
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        _pause(deadline, f"did not open port {port}")
