"""Signals of one site as plots, its states as a bar, and what happened in words."""

from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr

from telemetry.dashboard.canvas import Canvas
from telemetry.dashboard.styles import PALE, Policy, series, state_style, written
from telemetry.events import EventLog
from telemetry.picture import RED, WHITE, Colour, Picture, SiteView, blend
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

RESTATE_NS: Final = 5_000_000_000
CALM_NS: Final = 100_000_000
"""What nobody steers by is drawn this seldom: cost goes by the piece, not by the row."""


class Signals:
    """Draws one site's rows; one of the sites, with the `limits` that both share."""

    def __init__(
        self, canvas: Canvas, picture: Picture, view: SiteView, peer: SiteView, *, limits: bool
    ) -> None:
        self._limits = limits
        self._canvas = canvas
        self._picture = picture
        self._name = view.name
        self._clearance = view.clearance
        self._events = EventLog(view.name, picture.state_names, picture.cut_names)
        self._state: int | None = None
        self._stated_ns = 0
        self._calm: list[tuple[IntArray, RowArray]] = []
        state_style(canvas, f"state/{view.name}", picture.state_names)
        self._log_style(view, peer)

    def draw(self, times_ns: IntArray, rows: RowArray, *, everything: bool) -> None:
        """Draw rows (k,) at these times (k,) [ns]; of some signals later, unless everything."""
        if len(rows):
            self._draw_states(times_ns, rows)
            self._draw_at_once(times_ns, rows)
            self._calm.append((times_ns.copy(), rows.copy()))
            for time_ns, level, text in self._events.observe(times_ns, rows):
                draw_event(self._canvas, time_ns, level, text)
        if self._calm:
            since_ns = int(self._calm[-1][0][-1] - self._calm[0][0][0])
            if everything or since_ns >= 0.95 * CALM_NS:
                self._draw_calmly(*map(np.concatenate, zip(*self._calm, strict=True)))
                self._calm.clear()

    def _draw_at_once(self, times_ns: IntArray, rows: RowArray) -> None:
        def plot(path: str, *signals: FloatArray) -> None:
            self._canvas.plot(f"{path}/{self._name}", times_ns, *signals)

        plot("error", np.linalg.norm(rows["position_m"] - rows["peer_position_m"], axis=1) * 1e3)
        external_n = np.linalg.norm(rows["external_force_n"], axis=1)
        plot("force", external_n, np.linalg.norm(rows["coupling_force_n"], axis=1))
        certified_s = rows["certified_round_trip_s"]
        if np.isfinite(certified_s).any():
            plot("margin", (certified_s - rows["loop_bound_s"]) * 1e3)

    def _draw_calmly(self, times_ns: IntArray, rows: RowArray) -> None:
        def plot(path: str, *signals: FloatArray) -> None:
            self._canvas.plot(f"{path}/{self._name}", times_ns, *signals)

        plot("delay", rows["one_way_delay_s"] * 1e3)
        plot("lateness", rows["lateness_ns"] * 1e-3)
        plot("torque", rows["torque_nm"])
        plot("angle", rows["q"])
        plot("speed", rows["q_dot"])
        plot("round_trip", rows["loop_bound_s"] * 1e3)
        if self._limits:
            _plot_limits(self._canvas, times_ns, rows["certified_round_trip_s"])
        if self._clearance is not None:
            plot("clearance", self._clearance(rows["q"]) * 1e3)

    def _draw_states(self, times_ns: IntArray, rows: RowArray) -> None:
        for time_ns, state in zip(times_ns.tolist(), rows["state"].tolist(), strict=True):
            # Said again although unchanged: a viewer that comes late has lost what is older.
            if state != self._state or time_ns - self._stated_ns >= RESTATE_NS:
                self._state, self._stated_ns = state, time_ns
                told = rr.StateChange(state=str(state))
                self._canvas.log(f"state/{self._name}", time_ns, told)

    def _log_style(self, view: SiteView, peer: SiteView) -> None:
        own, pale, name = view.colour, blend(view.colour, WHITE, PALE), view.name

        def style(
            path: str, names: list[str], colours: list[Colour], how: Policy | None = None
        ) -> None:
            series(self._canvas, f"{path}/{name}", names, colours, how)

        def style_joints(path: str, symbol: str) -> None:
            count = view.joints
            names = [f"{name} {symbol}{i}" for i in range(1, count + 1)]
            shades = [blend(own, WHITE, 0.75 * i / max(count - 1, 1)) for i in range(count)]
            style(path, names, shades)

        style("error", [f"{name} to delayed {peer.name}"], [own])
        style("force", [f"{name} external", f"{name} coupling"], [own, pale])
        style_joints("torque", "τ")
        style_joints("angle", "q")
        style_joints("speed", "q̇")
        style("delay", [f"{peer.name} → {name}"], [peer.colour], Policy.Max)
        style("round_trip", [f"seen by {name}"], [own], Policy.Max)
        style("margin", [f"seen by {name}"], [own], Policy.Min)
        style("lateness", [name], [own], Policy.Max)
        style("clearance", [f"{name} links"], [own], Policy.Min)


def common_style(canvas: Canvas) -> None:
    """Style what both sites' rows tell together."""
    series(canvas, "error/apart", ["|local − remote|"], [WHITE])
    series(canvas, "round_trip/certified", ["certified"], [RED])
    series(canvas, "margin/limit", ["limit"], [RED])


def plot_apart(canvas: Canvas, times_ns: IntArray, apart_m: FloatArray) -> None:
    """Draw how far apart the robots' points are (k,) [m]; NaN where it is not known."""
    _plot_finite(canvas, "error/apart", times_ns, apart_m * 1e3)


def _plot_limits(canvas: Canvas, times_ns: IntArray, certified_s: FloatArray) -> None:
    _plot_finite(canvas, "round_trip/certified", times_ns, certified_s * 1e3)
    _plot_finite(canvas, "margin/limit", times_ns, np.where(np.isfinite(certified_s), 0.0, np.nan))


def _plot_finite(canvas: Canvas, path: str, times_ns: IntArray, values: FloatArray) -> None:
    finite = np.isfinite(values)
    if finite.all():
        canvas.plot(path, times_ns, values)
    elif finite.any():
        canvas.plot(path, times_ns[finite], values[finite])


def draw_event(canvas: Canvas, time_ns: int, level: str, text: str) -> None:
    """Add a line to the event log, with its time, for which the log's own column is too narrow."""
    stamped = f"{(time_ns - canvas.origin_ns) * 1e-9:8.3f} s  {written(text)}"
    canvas.log("events", time_ns, rr.TextLog(stamped, level=level))
