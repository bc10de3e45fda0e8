"""How far a chain is from a point."""

from collections.abc import Sequence
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
    (x, y, z), *ends = points
    sx, sy, sz = x - cx, y - cy, z - cz
    s2 = sx * sx + sy * sy + sz * sz
    link2 = midpoint2 = inf
    for x, y, z in ends:
        ex, ey, ez = x - cx, y - cy, z - cz
        lx, ly, lz = ex - sx, ey - sy, ez - sz
        # |s + λl|² = s² + 2λ s·l + λ²l², least where λ = −s·l/l²
        s_l, l2 = sx * lx + sy * ly + sz * lz, lx * lx + ly * ly + lz * lz
        middle2 = s2 + s_l + 0.25 * l2
        if middle2 < midpoint2:
            midpoint2 = middle2
        if s_l >= 0.0:
            nearest2 = s2
        elif -s_l < l2:
            nearest2 = s2 - s_l * s_l / l2
        else:
            nearest2 = s2 + 2.0 * s_l + l2
        if nearest2 < link2:
            link2 = nearest2
        sx, sy, sz = ex, ey, ez
        s2 += 2.0 * s_l + l2
    return sqrt(max(link2, 0.0)), sqrt(max(midpoint2, 0.0))


def segment_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the chain's links, through origins (n+1, 3), to the centre."""
    return distances(origins.tolist(), center_3d(center))[0]


def midpoint_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the nearest link midpoint to the centre, the paper's measure."""
    return distances(origins.tolist(), center_3d(center))[1]
