"""The studies' figures; the only module that imports matplotlib."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from experiments.case import Outcome
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import ObstacleSettings

if TYPE_CHECKING:  # every command passes here, and few draw
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]

COLOURS = ("#1f6fb4", "#d9722b", "#4c9a4c", "#8a56b0", "#c02f2f")
LOCAL, REMOTE, OTHER = COLOURS[:3]
_DPI = 90
_POSES = 14
_MARGIN_M = 0.08
_DELAYS_SHOWN_S = 20.0


def panels(rows: int, columns: int, size_in: tuple[float, float]) -> "tuple[Figure, list[Axes]]":
    """Return a figure and its axes, row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_in, layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False)))


def save(figure: "Figure", file: Path) -> None:
    """Write a PNG file; the same figure gives the same bytes."""
    figure.savefig(file, dpi=_DPI, metadata={"Software": None}, pil_kwargs={"optimize": True})


def curves(
    axes: "Axes",
    time_s: FloatArray,
    columns: Sequence[tuple[str, FloatArray, str]],
    title: str,
    *,
    logarithmic: bool = False,
) -> None:
    """Draw (label, values (r,), colour) over time."""
    for label, values, colour in columns:
        shown = min(len(time_s), len(values))
        axes.plot(time_s[:shown], values[:shown], label=label, color=colour, linewidth=1.2)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("time [s]", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    if logarithmic:
        axes.set_yscale("log")
    if any(label for label, _, _ in columns):
        axes.legend(fontsize=8)


def stroboscope(axes: "Axes", outcome: Outcome, title: str) -> None:
    """Draw the remote arm in poses evenly spaced along its way, pale to dark, and its obstacles."""
    session = outcome.case.session()
    chains = robot_of(session, SiteId.REMOTE).chain_rows(outcome.vector("remote_q"))
    travelled = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(chains, axis=0)).sum(axis=(1, 2)))))
    chosen = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], _POSES)).tolist()
    for shade, row in zip(np.linspace(0.15, 1.0, len(chosen)), chosen, strict=True):
        axes.plot(
            *chains[row, :, :2].T, "-o", color=REMOTE, alpha=shade, linewidth=1.5, markersize=2
        )
    ends = outcome.vector("local_position")
    axes.plot(ends[:, 0], ends[:, 1], color=LOCAL, linewidth=1.0, label="local end effector")
    ends = outcome.vector("remote_position")
    axes.plot(ends[:, 0], ends[:, 1], color=REMOTE, linewidth=1.0, label="remote end effector")
    for obstacle in session.remote.obstacles:
        _circles(axes, obstacle)
    points = chains[..., :2].reshape(-1, 2)
    axes.set_xlim(points[:, 0].min() - _MARGIN_M, points[:, 0].max() + _MARGIN_M)
    axes.set_ylim(points[:, 1].min() - _MARGIN_M, points[:, 1].max() + _MARGIN_M)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("X [m]", fontsize=9)
    axes.set_ylabel("Y [m]", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7)


def _circles(axes: "Axes", obstacle: ObstacleSettings) -> None:
    from matplotlib.patches import Circle

    x_m, y_m, *_ = obstacle.center_m
    for radius_m in (obstacle.collision_radius_m, obstacle.safe_radius_m):
        axes.add_patch(Circle((x_m, y_m), radius_m, fill=False, linestyle="--", color="#3b5bdb"))


def sub_task_figure(file: Path, without: Outcome, with_task: Outcome, task: str) -> None:
    """Draw what Figs. 2, 3 and 5 show: arms, forces, delays, TTE, manipulability, STE."""
    figure, axes = panels(2, 4, (16.0, 7.4))
    pair = (("without", without, LOCAL), ("with", with_task, REMOTE))
    stroboscope(axes[0], without, f"remote arm without {task}")
    stroboscope(axes[1], with_task, f"remote arm with {task}")
    force = with_task.vector("local_external_force")
    curves(
        axes[2],
        with_task.time_s,
        (("X", force[:, 0], LOCAL), ("Y", force[:, 1], REMOTE)),
        "force of the hand [N]",
    )
    curves(
        axes[3],
        with_task.time_s[with_task.time_s < _DELAYS_SHOWN_S],
        (
            ("local to remote", with_task.scalar("remote_one_way_delay_s"), LOCAL),
            ("remote to local", with_task.scalar("local_one_way_delay_s"), REMOTE),
            ("whole loop", with_task.scalar("local_round_trip_s"), OTHER),
        ),
        "age of the sample in use [s]",
    )
    longest = max(without.time_s, with_task.time_s, key=len)
    for axis, component in enumerate("XY"):
        curves(
            axes[4 + axis],
            longest,
            [(label, outcome.error_m()[:, axis], colour) for label, outcome, colour in pair],
            f"TTE in {component} [m]",
        )
    for place, column, title in (
        (6, "remote_manipulability", "manipulability det(J_r J_rᵀ) [m⁴]"),
        (7, "remote_sub_task_error_rad_s", "‖STE‖ [rad/s]"),
    ):
        curves(
            axes[place],
            longest,
            [(label, outcome.scalar(column), colour) for label, outcome, colour in pair],
            title,
        )
    save(figure, file)


def synchronisation_figure(file: Path, outcome: Outcome, title: str) -> None:
    """Draw what Fig. 4 shows: the hand's force and both end effectors, by axis."""
    figure, axes = panels(2, 2, (12.0, 6.6))
    figure.suptitle(title, fontsize=11)
    force = outcome.vector("local_external_force")
    local, remote = (outcome.vector(f"{site}_position") for site in ("local", "remote"))
    for axis, component in enumerate("XY"):
        curves(
            axes[axis],
            outcome.time_s,
            (("", force[:, axis], OTHER),),
            f"force of the hand in {component} [N]",
        )
        curves(
            axes[2 + axis],
            outcome.time_s,
            (("local", local[:, axis], LOCAL), ("remote", remote[:, axis], REMOTE)),
            f"end effectors in {component} [m]",
        )
    save(figure, file)


@dataclass(frozen=True, slots=True)
class MapPoint:
    """One simulated pair of stiffness and round trip: converged, slow or diverged."""

    stiffness_n_per_m: float
    round_trip_s: float
    verdict: str
    certified: bool


_MARKS = {"converged": ("o", "#2f9e44"), "slow": ("D", "#f0a500"), "diverged": ("X", "#c02f2f")}


def map_figure(
    file: Path,
    maps: Sequence[tuple[str, Sequence[MapPoint], Mapping[str, Sequence[tuple[float, float]]]]],
) -> None:
    """Draw maps side by side: title, points, and certified round trip over stiffness by theorem."""
    figure, axes = panels(1, len(maps), (5.4 * len(maps), 4.8))
    for place, (title, points, limits) in zip(axes, maps, strict=True):
        for (theorem, limit), colour in zip(limits.items(), COLOURS, strict=False):
            place.plot(*np.array(limit).T, color=colour, linewidth=1.5, label=theorem)
        for verdict, (marker, colour) in _MARKS.items():
            chosen = [point for point in points if point.verdict == verdict]
            place.scatter(
                [point.stiffness_n_per_m for point in chosen],
                [point.round_trip_s for point in chosen],
                marker=marker,
                color=colour,
                s=[70.0 if point.certified else 28.0 for point in chosen],
                label=verdict,
                zorder=3,
            )
        place.set_xscale("log")
        place.set_yscale("log")
        trips_s = [point.round_trip_s for point in points]
        place.set_ylim(0.6 * min(trips_s), 1.7 * max(trips_s))
        place.set_title(title, fontsize=10)
        place.set_xlabel("stiffness K [N/m]", fontsize=9)
        place.set_ylabel("round trip T [s]", fontsize=9)
        place.tick_params(labelsize=8)
        place.grid(alpha=0.3, which="both")
        place.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)
    save(figure, file)
