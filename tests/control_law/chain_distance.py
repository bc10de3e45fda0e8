"""How far a chain is from a point, as plainly as it can be said."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def segment_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the chain's links, through origins (n+1, 3), to the centre."""
    starts, links = origins[:-1] - _center_3d(center), np.diff(origins, axis=0)
    distances = []
    for start, link in zip(starts, links, strict=True):
        length2 = float(link @ link)
        along = -float(start @ link) / length2 if length2 > 0.0 else 0.0
        distances.append(float(np.linalg.norm(start + np.clip(along, 0.0, 1.0) * link)))
    return min(distances)


def midpoint_distance(origins: FloatArray, center: FloatArray) -> float:
    """Return the distance [m] from the nearest link midpoint to the centre, the paper's measure."""
    midpoints = 0.5 * (origins[:-1] + origins[1:])
    return float(np.linalg.norm(midpoints - _center_3d(center), axis=1).min())


def _center_3d(center: FloatArray) -> FloatArray:
    return np.array([*center, 0.0])[:3]
