"""Colours and lines, the same in every view."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import rerun as rr

from telemetry.dashboard.canvas import Canvas
from telemetry.picture import GREY, Colour, Picture

Policy = rr.components.AggregationPolicy

PALE: Final = 0.6
GREEN: Final[Colour] = (64, 160, 84)

STATE_COLOURS: Final[Mapping[str, Colour]] = {
    "OFFLINE": (92, 92, 92),
    "READY": (84, 110, 168),
    "ALIGNING": (58, 158, 176),
    "ENGAGED": GREEN,
    "HOLD": (201, 162, 39),
    "RELEASED": (148, 103, 189),
    "FAULT": (208, 62, 62),
    "EMERGENCY_STOP": (232, 30, 140),
}


class Shapes(NamedTuple):
    """Rerun's lines, points and arrows of as many dimensions as the task has."""

    strips: Any
    points: Any
    arrows: Any


def shapes(picture: Picture) -> Shapes:
    """Return the kinds that a picture is drawn with."""
    if picture.spatial:
        return Shapes(rr.LineStrips3D, rr.Points3D, rr.Arrows3D)
    return Shapes(rr.LineStrips2D, rr.Points2D, rr.Arrows2D)


def series(
    canvas: Canvas,
    path: str,
    names: list[str],
    colours: list[Colour],
    how: Policy | None = None,
    width: float = 1.5,
) -> None:
    """Style the signals at a path; where one pixel holds many ticks, `how` says what is shown."""
    style = rr.SeriesLines(names=names, colors=colours, widths=width, aggregation_policy=how)
    canvas.log_static(path, style)


def state_style(canvas: Canvas, path: str, names: Mapping[int, str]) -> None:
    """Style a bar of supervisor states."""
    states = rr.StateConfiguration(
        values=[str(state) for state in names],
        labels=list(names.values()),
        colors=[STATE_COLOURS.get(name, GREY) for name in names.values()],
    )
    canvas.log_static(path, states)


def written(text: str) -> str:
    """Replace what the viewer has no letters for: it would end on them.

    Its font, Inter, has Latin, Greek and Cyrillic letters.
    """
    return "".join(c if c.isprintable() and ord(c) < 0x0500 else "?" for c in text)
