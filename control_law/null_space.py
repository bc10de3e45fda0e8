"""Self-motion: joint velocities that the end effector does not see."""

import numpy as np
import numpy.typing as npt

from control_law.adjugate import gram_adjugate, gram_adjugate_rate

FloatArray = npt.NDArray[np.float64]


def manipulability(J: FloatArray) -> float:
    """Return w = det(JJᵀ), the paper's manipulability index (Section VI)."""
    w, _ = gram_adjugate(J)
    return w


def project(J: FloatArray, v: FloatArray, regularisation: float = 0.0) -> FloatArray:
    """Return w/(w+ε)·(I − J⁺J) v, (n,), ε the regularisation; with v = s this is the STE of (21).

    It lies in the null space of J at every pose. ε = 0 is the paper's projector, which has no
    value where w = 0 (ZeroDivisionError).
    """
    w, adjugate = gram_adjugate(J)
    scale = 1.0 / (w + regularisation)
    return (w * v - (adjugate @ (J @ v)) @ J) * scale


def null_space_velocity(
    J: FloatArray, J_dot: FloatArray, g: FloatArray, g_dot: FloatArray, regularisation: float
) -> tuple[FloatArray, FloatArray]:
    """Return ζ = [wI − Jᵀ adj(JJᵀ) J] g/(w+ε) and ζ̇, both (n,), w = det(JJᵀ).

    This is w/(w+ε) times ζ of (4): Jζ = 0 at every pose, so the theorems hold as they stand,
    and it goes smoothly to zero at a singularity, where (4) has no value. A damped
    pseudo-inverse would leave Jζ ≠ 0. ε ≥ 0 in the unit of w, about 1e-3 of its largest value;
    ε = 0 is exactly (4) and raises ZeroDivisionError where w = 0.
    """
    w, w_dot, adjugate, adjugate_dot = gram_adjugate_rate(J, J_dot)
    task = J @ g
    y = adjugate @ task
    y_dot = adjugate_dot @ task + adjugate @ (J_dot @ g + J @ g_dot)
    scale = 1.0 / (w + regularisation)
    zeta = (w * g - y @ J) * scale
    zeta_dot = (w_dot * g + w * g_dot - y @ J_dot - y_dot @ J - w_dot * zeta) * scale
    return zeta, zeta_dot
