"""What stands around the arms: obstacles and walls."""

from typing import Any

import numpy as np
import rerun as rr

from telemetry.dashboard.canvas import Canvas
from telemetry.dashboard.styles import shapes, written
from telemetry.picture import BACKGROUND, RED, Picture, blend, circle, wall_lines


def draw_scene(canvas: Canvas, picture: Picture) -> None:
    """Draw obstacles, each with the distance to keep, and walls; once for all."""
    if picture.scene.obstacles:
        _draw_obstacles(canvas, picture)
    lines = [
        line
        for wall in picture.scene.walls
        for line in wall_lines(wall, picture.reach_m, spatial=picture.spatial)
    ]
    if lines:
        faint = blend(RED, BACKGROUND, 0.5 if picture.spatial else 0.25)
        radius = (0.15 if picture.spatial else 0.4) * picture.reach_m / 90
        strips = shapes(picture).strips
        canvas.log_static("scene/world/walls", strips(lines, colors=faint, radii=radius))
    if not picture.spatial:
        # The viewer's y axis points down in two dimensions; the robots' points up.
        up = rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])
        canvas.log_static("scene", up)


def _draw_obstacles(canvas: Canvas, picture: Picture) -> None:
    obstacles, width = picture.scene.obstacles, picture.reach_m / 90
    centers = [obstacle.center_m for obstacle in obstacles]
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
    canvas.log_static("scene/world/obstacles", solid)
    canvas.log_static("scene/world/safe", safe)
    # A name is written below its point: below the obstacle, then.
    feet = [np.array(o.center_m) - (0.0, o.safe_radius_m, 0.0) for o in obstacles]
    positions = picture.place(np.array(centers if picture.spatial else feet))
    names = [written(obstacle.name) for obstacle in obstacles]
    points = shapes(picture).points(positions, colors=RED, radii=0.2 * width, labels=names)
    canvas.log_static("scene/world/names", points)
