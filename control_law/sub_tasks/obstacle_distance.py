"""How far a chain is from a point."""

from itertools import pairwise
from math import inf, sqrt

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import Vector, center_3d, dot, minus, plus

FloatArray = npt.NDArray[np.float64]


def closest_parameter(start: Vector, link: Vector, center: Vector) -> float:
    """Return λ in [0, 1] that brings start + λ·link nearest to the centre."""
    length2 = dot(link, link)
    if length2 == 0.0:  # two joint centres may coincide
        return 0.0
    return min(max(dot(link, minus(center, start)) / length2, 0.0), 1.0)


def segment_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the chain's links, through origins (n+1, 3), to the centre."""
    target, points = center_3d(center), origins.tolist()
    least = inf
    for start, end in pairwise(points):
        link = minus(end, start)
        offset = minus(plus(start, link, closest_parameter(start, link, target)), target)
        least = min(least, dot(offset, offset))
    return sqrt(least)


def midpoint_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the nearest link midpoint to the centre, the paper's measure."""
    target, points = center_3d(center), origins.tolist()
    least = inf
    for start, end in pairwise(points):
        offset = minus(plus(start, minus(end, start), 0.5), target)
        least = min(least, dot(offset, offset))
    return sqrt(least)
