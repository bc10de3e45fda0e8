"""A recording, or a result, as one figure: panels over session time, both sites in each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from experiments.plots import panels, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = npt.NDArray[np.float64]

PIECES: Final = 2000
"""Of a longer curve, the least and greatest of so many pieces are drawn: no spike is lost."""

_STATE_COLOURS: Final = MappingProxyType(
    {
        "OFFLINE": "#9a9a9a",
        "READY": "#8ea4d2",
        "ALIGNING": "#74c0d8",
        "ENGAGED": "#6fbf7f",
        "HOLD": "#e3b341",
        "RELEASED": "#b9a3d6",
        "FAULT": "#d64545",
        "EMERGENCY_STOP": "#8c1c1c",
    }
)
_SHADES: Final = MappingProxyType(
    {
        "local": ("#d9722b", "#8a3a0c", "#f5a85c", "#b58900", "#e8b999", "#5e3a1a", "#ff6b4a"),
        "remote": ("#1f6fb4", "#0b3357", "#6db3f2", "#5f5fc4", "#2a9d8f", "#a5c8ec", "#3b4b7a"),
    }
)
_OTHER: Final = "#7a7a7a"
_LIMIT: Final = "#c02f2f"
_APART: Final = "#222222"
_GAP_STYLE: Final[Mapping[str, Any]] = MappingProxyType(
    {"facecolor": "#f4f4f4", "edgecolor": "#c4c4c4", "hatch": "///", "linewidth": 0.6, "zorder": 0}
)
_WIDTH_IN: Final = 14.0
_PANEL_IN: Final = 2.2
_BANDS_IN: Final = 1.1
_FAR_BEYOND: Final = 4.0
_LINEAR_US: Final = 100.0  # the scale is logarithmic above
_JOINTS_A_COLUMN: Final = 8
_NAMED_SHARE: Final = 0.06  # of the width, from which a band has room for its name


@dataclass(frozen=True, slots=True)
class SiteTrace:
    """Rows of one site: session time (r,) [s], and row fields by name, (r,) or (r, n)."""

    site: str
    time_s: FloatArray
    fields: Mapping[str, npt.NDArray[Any]]

    def norm(self, field: str) -> FloatArray:
        """Length (r,) of a vector."""
        return np.asarray(np.linalg.norm(self.fields[field], axis=1), np.float64)

    def within(self, start_s: float, end_s: float) -> "SiteTrace":
        """Return the rows from one session time to another."""
        rows = slice(*np.searchsorted(self.time_s, (start_s, end_s)).tolist())
        fields = {name: values[rows] for name, values in self.fields.items()}
        return SiteTrace(self.site, self.time_s[rows], fields)


def recording_figure(
    file: Path,
    title: str,
    traces: Sequence[SiteTrace],
    state_names: Mapping[int, str],
    chosen: Sequence[str] = (),
) -> None:
    """Draw these panels (all if none is chosen) of one or both sites into a PNG file."""
    names = [name for name in PANELS if not chosen or name in chosen]
    heights_in = [_BANDS_IN if name == "states" else _PANEL_IN for name in names]
    figure, axes = panels(len(names), 1, (_WIDTH_IN, sum(heights_in) + 0.5))
    axes[0].get_gridspec().set_height_ratios(heights_in)  # type: ignore[union-attr]
    figure.suptitle(title, fontsize=11)
    start_s = min(float(trace.time_s[0]) for trace in traces)
    end_s = max(float(trace.time_s[-1]) for trace in traces)
    for place, name in zip(axes, names, strict=True):
        PANELS[name](_Panel(place, traces, state_names))
        place.set_xlim(start_s, max(end_s, start_s + 1e-3))
        place.tick_params(labelsize=8)
        place.broken_barh(
            _gaps_s(traces), (0, 1), transform=place.get_xaxis_transform(), **_GAP_STYLE
        )
    for place in axes[:-1]:
        place.tick_params(labelbottom=False)
    axes[-1].set_xlabel("session time [s]", fontsize=9)
    save(figure, file)


@dataclass(frozen=True, slots=True)
class _Panel:
    """One panel being drawn."""

    axes: "Axes"
    traces: Sequence[SiteTrace]
    state_names: Mapping[int, str]

    def curve(
        self, trace: SiteTrace, values: FloatArray, label: str, colour: str, style: str = "-"
    ) -> None:
        self.axes.plot(*_outline(trace, values), style, label=label, color=colour, linewidth=1.1)

    def legend(self, columns: int = 1) -> None:
        """Put the legend beside the curves."""
        self.axes.legend(
            fontsize=8,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.04),
            frameon=False,
            handlelength=1.3,
            labelspacing=0.35,
            columnspacing=0.9,
            ncols=columns,
        )

    def finish(self, label: str, floor: float | None = None) -> None:
        """Name the axis, add what all panels have, and let the axis begin at `floor`."""
        self.axes.set_ylabel(label, fontsize=9)
        self.axes.grid(alpha=0.3)
        if self.axes.get_legend() is None:
            self.legend()
        if floor is not None:
            self.axes.set_ylim(bottom=floor)


def _draw_states(panel: _Panel) -> None:
    axes, sites = panel.axes, [trace.site for trace in panel.traces]
    whole_s = max(trace.time_s[-1] for trace in panel.traces) - min(
        trace.time_s[0] for trace in panel.traces
    )
    for row, trace in enumerate(panel.traces):
        for start_s, end_s, state in _stretches(trace):
            name = panel.state_names.get(state, f"state {state}")
            colour = _STATE_COLOURS.get(name, _OTHER)
            axes.broken_barh([(start_s, end_s - start_s)], (row - 0.4, 0.8), facecolors=colour)
            if end_s - start_s > _NAMED_SHARE * whole_s:
                axes.text(
                    *((start_s + end_s) / 2, row, _words(name)),
                    ha="center",
                    va="center",
                    fontsize=8,
                    clip_on=True,
                )
    axes.set_yticks(range(len(sites)), sites)
    axes.set_ylim(len(sites) - 0.5, -0.5)
    for state in sorted(
        {n for trace in panel.traces for n in np.unique(trace.fields["state"]).tolist()}
    ):
        name = panel.state_names.get(state, f"state {state}")
        axes.plot([], [], "s", color=_STATE_COLOURS.get(name, _OTHER), label=_words(name))
    panel.legend()


def _draw_error(panel: _Panel) -> None:
    for trace in panel.traces:
        apart_m = trace.fields["position_m"] - trace.fields["peer_position_m"]
        error_mm = 1e3 * np.linalg.norm(apart_m, axis=1)
        panel.curve(trace, error_mm, f"{trace.site} to delayed peer", _SHADES[trace.site][0])
    if len(panel.traces) == 2:
        local, remote = panel.traces
        told_m = local.fields["position_m"] - local.fields["offset_m"]
        there_m = np.column_stack(
            [
                np.interp(local.time_s, remote.time_s, axis_m, left=np.nan, right=np.nan)
                for axis_m in remote.fields["position_m"].T
            ]
        )
        panel.curve(
            local, 1e3 * np.linalg.norm(told_m - there_m, axis=1), "|local − remote|", _APART
        )
    panel.finish("position error [mm]", 0.0)


def _draw_force(panel: _Panel) -> None:
    for trace in panel.traces:
        dark, pale = _SHADES[trace.site][0], _SHADES[trace.site][2]
        panel.curve(trace, trace.norm("external_force_n"), f"{trace.site} external", dark)
        panel.curve(trace, trace.norm("coupling_force_n"), f"{trace.site} coupling", pale, "--")
    panel.finish("force [N]", 0.0)


def _draw_torque(panel: _Panel) -> None:
    for trace in panel.traces:
        shades = _SHADES[trace.site]
        for joint, torque_nm in enumerate(trace.fields["torque_nm"].T):
            colour = shades[joint % len(shades)]
            panel.curve(trace, torque_nm, f"{trace.site} {joint + 1}", colour)
    joints = sum(trace.fields["torque_nm"].shape[1] for trace in panel.traces)
    panel.legend(columns=1 if joints <= _JOINTS_A_COLUMN else 2)
    panel.finish("joint torque [N·m]")


def _draw_age(panel: _Panel) -> None:
    for trace in panel.traces:
        age_ms = 1e3 * trace.fields["loop_bound_s"]
        panel.curve(trace, age_ms, f"greatest, seen by {trace.site}", _SHADES[trace.site][0])
    first = panel.traces[0]
    certified_ms = 1e3 * first.fields["certified_round_trip_s"]
    panel.curve(first, certified_ms, "certified", _LIMIT, "--")
    linear_ms = float(np.max(certified_ms, initial=1.0))
    if panel.axes.get_ylim()[1] > _FAR_BEYOND * linear_ms:
        panel.axes.set_yscale("symlog", linthresh=linear_ms)  # or the limit lies on the floor
    panel.finish("loop age [ms]", 0.0)


def _draw_lateness(panel: _Panel) -> None:
    for trace in panel.traces:
        late_us = 1e-3 * trace.fields["lateness_ns"]
        panel.curve(trace, late_us, trace.site, _SHADES[trace.site][0])
    panel.axes.set_yscale("symlog", linthresh=_LINEAR_US)
    panel.finish("lateness [µs]", 0.0)
    panel.axes.set_ylim(top=max(_LINEAR_US, panel.axes.get_ylim()[1]))


PANELS: Final[Mapping[str, Callable[[_Panel], None]]] = MappingProxyType(
    {
        "states": _draw_states,
        "error": _draw_error,
        "force": _draw_force,
        "torque": _draw_torque,
        "age": _draw_age,
        "lateness": _draw_lateness,
    }
)


def _words(state_name: str) -> str:
    return state_name.replace("_", " ").lower()


def _outline(trace: SiteTrace, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points of a curve (p,): all, or the extremes of its pieces; NaN where rows are missing."""
    size = -(-len(values) // PIECES)
    times_s, points = [], []
    for rows in np.split(np.arange(len(values)), _breaks(trace)):
        starts = np.arange(0, len(rows), size)
        part_s, part = trace.time_s[rows], np.asarray(values[rows], np.float64)
        if size > 1:
            part_s = np.repeat(part_s[starts], 2)
            extremes = (np.fmin.reduceat(part, starts), np.fmax.reduceat(part, starts))
            part = np.column_stack(extremes).ravel()
        times_s += [part_s, part_s[-1:]]
        points += [part, np.array([np.nan])]
    return np.concatenate(times_s[:-1]), np.concatenate(points[:-1])


def _breaks(trace: SiteTrace) -> npt.NDArray[np.intp]:
    """Return the first row after each gap, and of each further run."""
    return np.flatnonzero(np.diff(trace.fields["sequence"].astype(np.int64)) != 1) + 1


def _gaps_s(traces: Sequence[SiteTrace]) -> list[tuple[float, float]]:
    """Start and length [s] of what is missing."""
    return [
        (float(trace.time_s[row - 1]), float(trace.time_s[row] - trace.time_s[row - 1]))
        for trace in traces
        for row in _breaks(trace)
    ]


def _stretches(trace: SiteTrace) -> list[tuple[float, float, int]]:
    """Start [s], end [s] and number of each stretch in one state; gaps are in none."""
    found = []
    for rows in np.split(np.arange(len(trace.time_s)), _breaks(trace)):
        states = trace.fields["state"][rows].astype(int)
        changes = np.flatnonzero(np.diff(states)) + 1
        for first, end in zip((0, *changes), (*changes, len(rows) - 1), strict=True):
            found.append(
                (
                    float(trace.time_s[rows[first]]),
                    float(trace.time_s[rows[end]]),
                    int(states[first]),
                )
            )
    return found
