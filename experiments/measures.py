"""Figures that the paper and its studies read off a run."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def settling_time_s(time_s: FloatArray, error_m: FloatArray, limit_m: float) -> float | None:
    """Return when the error last came below the limit for good [s]; None if it never did."""
    above = np.flatnonzero(error_m > limit_m)
    if above.size == 0:
        return float(time_s[0])
    first_below = above[-1] + 1
    return float(time_s[first_below]) if first_below < len(time_s) else None
