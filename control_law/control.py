"""The controller (6)."""

import numpy as np
import numpy.typing as npt

from control_law.damping import Damping
from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


def reference_error(q_dot: FloatArray, zeta: FloatArray) -> FloatArray:
    """Return s = q̇ − ζ of (4) [rad/s], (n,)."""
    return q_dot - zeta


def minus_theta(
    M: FloatArray, C: FloatArray, G: FloatArray, zeta: FloatArray, zeta_dot: FloatArray
) -> FloatArray:
    """Return −Θ = Mζ̇ + Cζ + G of (5) [N·m], (n,)."""
    torque: FloatArray = M.dot(zeta_dot)
    torque += C.dot(zeta)
    torque += G
    return torque


def control_torque(
    terms: Terms,
    coupling_force: FloatArray,
    damping: Damping,
    zeta: FloatArray,
    zeta_dot: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return τ = −Θ − Jᵀ ΩP(e) − Λs of (6) [N·m] and s [rad/s], both (n,).

    `coupling_force` is ΩP(e) [N], (z,), as scaled by the caller. The local site has ζ = ζ̇ = 0.
    """
    s = reference_error(terms.q_dot, zeta)
    torque = minus_theta(terms.M, terms.C, terms.G, zeta, zeta_dot)
    torque -= coupling_force.dot(terms.J)
    torque -= damping.apply(terms.J, s)
    return torque, s
