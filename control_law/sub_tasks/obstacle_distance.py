"""How far a chain is from a point."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf, sqrt

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import Vector, center_3d

FloatArray = npt.NDArray[np.float64]


def closest_parameter(sx: float, sy: float, sz: float, lx: float, ly: float, lz: float) -> float:
    """Return λ in [0, 1] that brings s + λl nearest to 0: s a link's start from a centre, l it."""
    length2 = lx * lx + ly * ly + lz * lz
    if length2 == 0.0:  # two joint centres may coincide
        return 0.0
    along = -(lx * sx + ly * sy + lz * sz) / length2
    return 0.0 if along <= 0.0 else min(along, 1.0)


def distances(points: Sequence[Vector], center: Vector) -> tuple[float, float]:
    """Return the distance [m] from a centre to the links, and to the nearest link midpoint.

    The links go through n+1 points; midpoints are the paper's measure.
    """
    cx, cy, cz = center
    link2 = midpoint2 = inf
    for (ax, ay, az), (bx, by, bz) in pairwise(points):
        lx, ly, lz = bx - ax, by - ay, bz - az
        sx, sy, sz = ax - cx, ay - cy, az - cz
        along = closest_parameter(sx, sy, sz, lx, ly, lz)
        ox, oy, oz = sx + along * lx, sy + along * ly, sz + along * lz
        distance2 = ox * ox + oy * oy + oz * oz
        if distance2 < link2:
            link2 = distance2
        ox, oy, oz = sx + 0.5 * lx, sy + 0.5 * ly, sz + 0.5 * lz
        distance2 = ox * ox + oy * oy + oz * oz
        if distance2 < midpoint2:
            midpoint2 = distance2
    return sqrt(link2), sqrt(midpoint2)


def segment_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the chain's links, through origins (n+1, 3), to the centre."""
    return distances(origins.tolist(), center_3d(center))[0]


def midpoint_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the nearest link midpoint to the centre, the paper's measure."""
    return distances(origins.tolist(), center_3d(center))[1]
