"""How far a chain is from a point."""

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import center_3d, row_dot

FloatArray = npt.NDArray[np.float64]


def closest_parameter(origins: FloatArray, center: FloatArray) -> FloatArray:
    """Return λ in [0, 1], (n,): the link's point nearest to the centre (3,) is o + λ(o′ − o)."""
    links = np.diff(origins, axis=0)
    length2 = row_dot(links, links)
    # Two joint centres may coincide: that link is a point.
    length2[length2 == 0.0] = 1.0
    return (row_dot(links, center - origins[:-1]) / length2).clip(0.0, 1.0)


def segment_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the chain's links, through origins (n+1, 3), to the centre."""
    center = center_3d(center)
    along = closest_parameter(origins, center)
    offset = origins[:-1] + along[:, None] * np.diff(origins, axis=0) - center
    return float(np.sqrt(row_dot(offset, offset).min()))


def midpoint_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the nearest link midpoint to the centre, the paper's measure."""
    offset = 0.5 * (origins[1:] + origins[:-1]) - center_3d(center)
    return float(np.sqrt(row_dot(offset, offset).min()))
