"""How much damping a sampled loop can carry.

A damper applied once a period to a mass is a discrete loop of its own, whatever the network
does; a = T_s λ_max(M⁻¹Λ) measures it. Offline.
"""

from math import sqrt

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

# Zero-order hold on a mass: the loop is stable strictly below these values of a.
LIMIT_IMMEDIATE = 2.0  # velocity exact, or a difference of positions; torque acts at once
LIMIT_LATE_EXACT = 1.0  # velocity exact; torque acts one period late
LIMIT_LATE_DIFFERENCE = 2.0 * (sqrt(2.0) - 1.0)  # difference of positions; one period late
ADVISED_RATIO = 0.4  # half of the least of them, nearly

# A velocity through a first-order filter τ_f damps the mode λ with the ratio ½/√(λτ_f): 0.71 here.
ADVISED_FILTER_RATIO = 0.5


def damping_ratio(period_s: float, M: FloatArray, Lambda: FloatArray) -> float:
    """Return a = T_s λ_max(M⁻¹Λ) at one pose, for M and Λ (n, n) symmetric, M positive."""
    root = np.linalg.inv(np.linalg.cholesky(M))
    return period_s * float(np.linalg.eigvalsh(root @ Lambda @ root.T)[-1])
