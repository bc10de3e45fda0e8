"""The nearest vector that points into none of some forbidden directions."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
_ROUNDING = 1e-12


def nearest_not_along(vector: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the vector (n,) nearest to this one with no component along any of `rows` (m, n).

    The rows are of length 1. The forbidden components are taken away together: one by one, rows at
    an obtuse angle bring back what the other took. 0, which is always allowed, if rounding wins.
    """
    acting: list[int] = []
    result = vector
    for _ in range(3 * len(rows)):
        along = rows @ result - _ROUNDING * (np.abs(rows) @ (np.abs(vector) + np.abs(result)))
        along[acting] = 0.0
        worst = int(along.argmax())
        if along[worst] <= 0.0:
            return result
        acting.append(worst)
        try:
            chosen, shares = _shares(vector, rows, acting)
            while shares.min(initial=0.0) < 0.0:  # this one would pull: the others do without it
                del acting[int(shares.argmin())]
                chosen, shares = _shares(vector, rows, acting)
        except np.linalg.LinAlgError:
            break
        result = vector - shares @ chosen
    return np.zeros_like(vector)


def _shares(
    vector: FloatArray, rows: FloatArray, acting: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Return the rows that act, and how much of each it takes to be free of all of them."""
    chosen = rows[acting]
    shares = np.linalg.solve(chosen @ chosen.T, chosen @ vector)
    return chosen, np.asarray(shares, np.float64)
