"""Which views there are, and where."""

from typing import Final

import numpy as np
import rerun.blueprint as rrb

from telemetry.dashboard.canvas import TIMELINE
from telemetry.picture import BACKGROUND, Extent, Picture, SiteView

WINDOW_S: Final = 10.0


def blueprint(picture: Picture, extent: Extent) -> rrb.Blueprint:
    """Return the layout, for one screen of 1920 by 1080 pixels."""
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S)
    end = rrb.TimeRangeBoundary.cursor_relative()
    # The range limits what is queried; the axis, what is seen: both, or the axis breathes.
    time_range = rrb.VisibleTimeRange(TIMELINE, start=start, end=end)
    time_axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end), zoom_lock=True)

    def plot(
        path: str,
        name: str,
        range_: tuple[float, float] | None = None,
        *,
        legend: bool = False,
    ) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=f"/{path}",
            name=name,
            axis_x=time_axis,
            axis_y=None if range_ is None else rrb.ScalarAxis(range=range_, zoom_lock=True),
            # A legend hides what is behind it: on the first page, titles say what is what.
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
            time_ranges=[time_range],
        )

    tabs = [
        _events(),
        plot("torque", "Torques [N·m]", legend=True),
        plot("angle", "Angles [rad]", legend=True),
        plot("speed", "Speeds [rad/s]", legend=True),
        plot("round_trip", "Loop age [ms]", legend=True),
    ]
    if picture.scene.obstacles:
        tabs.append(plot("clearance", "Clearance [mm]", legend=True))
    middle = [
        plot("error", "Position error [mm] · white: between the points"),
        plot("force", "Force [N] · pale: of the coupling"),
    ]
    if picture.meter is not None:
        middle += [
            plot("energy", "Energy of the proof [J] · thin: its parts"),
            plot("exchange", "Energy put in [J] · pale: taken out by damping"),
        ]
    right = [
        plot("margin", "Margin of the certificate [ms]", _margin_range(picture)),
        plot("delay", "One-way delay [ms]"),
        rrb.TextDocumentView(origin="/latency", name="Latency [ms] · median / p99 of 5 s"),
        plot("lateness", "Loop lateness [µs]"),
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.TextDocumentView(origin="/certificate", name="Certificate", titlebar=False),
                rrb.Horizontal(*(_arm(picture, extent, view) for view in picture.sites)),
                rrb.StateTimelineView(origin="/state", name="Supervisor", time_view=time_axis),
                rrb.Tabs(*tabs, active_tab=0),
                row_shares=[1.3, 5, 1.4, 2.2],
            ),
            rrb.Vertical(*middle),
            rrb.Vertical(*right, row_shares=[1.0, 1.0, 1.2, 0.8]),
            column_shares=[5, 3, 3],
        ),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
    )


def _arm(picture: Picture, extent: Extent, view: SiteView) -> rrb.View:
    (peer,) = (other.name for other in picture.sites if other is not view)
    name = f"{view.name.capitalize()} · {view.joints} joints · dim: {peer} as received"
    contents = ["/scene/world/**", f"/scene/{view.name}/**", f"/mesh_{view.name}/**"]
    low, high = extent.low, extent.high
    if picture.spatial:
        center = (low + high) / 2
        eye = center + picture.reach_m * np.array([-0.4, -1.0, 0.6])
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


def _events() -> rrb.View:
    return rrb.TextLogView(
        origin="/events",
        name="Events",
        columns=rrb.TextLogColumns(
            # Too narrow for its times, which the text has instead.
            timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
        format_options=rrb.TextLogFormat(monospace_body=True),
    )


def _margin_range(picture: Picture) -> tuple[float, float] | None:
    """Return a range [ms] in which the limit, at zero, keeps its place."""
    certificate = picture.certificate
    if certificate is None or not 0.0 < certificate.round_trip_s < np.inf:
        return None
    return (-0.3e3 * certificate.round_trip_s, 1.3e3 * certificate.round_trip_s)
