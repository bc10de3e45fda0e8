"""Determinant and adjugate of JJᵀ with their rates: polynomials, so no pose is singular."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def gram_adjugate(J: FloatArray) -> tuple[float, FloatArray]:
    """Return w = det(JJᵀ) and adj(JJᵀ), (z, z), for z = 2 or 3."""
    gram = J @ J.T
    adjugate = _adjugate(gram)
    return float(gram[0].dot(adjugate[0])), adjugate


def gram_adjugate_rate(
    J: FloatArray, J_dot: FloatArray
) -> tuple[float, float, FloatArray, FloatArray]:
    """Return w, ẇ, adj(JJᵀ) and its time derivative, for z = 2 or 3."""
    gram = J @ J.T
    half = J_dot @ J.T
    gram_dot = half + half.T
    adjugate = _adjugate(gram)
    w = float(gram[0].dot(adjugate[0]))
    w_dot = float(np.vdot(adjugate, gram_dot))  # Jacobi's formula
    if len(gram) == 2:
        return w, w_dot, adjugate, _adjugate_2(gram_dot)
    return w, w_dot, adjugate, _adjugate_polar_3(gram, gram_dot)


def _adjugate(B: FloatArray) -> FloatArray:
    if len(B) == 2:
        return _adjugate_2(B)
    if len(B) == 3:
        return 0.5 * _adjugate_polar_3(B, B)
    raise ValueError(f"a task of dimension {len(B)} has no closed form here: use 2 or 3")


def _adjugate_2(B: FloatArray) -> FloatArray:
    """Return adj(B), linear in the symmetric 2×2 B."""
    (a, b), (_, c) = B.tolist()
    return np.array(((c, -b), (-b, a)))


def _adjugate_polar_3(B: FloatArray, B_dot: FloatArray) -> FloatArray:
    """Return d/dt adj(B) for symmetric 3×3 B: bilinear, and 2 adj(B) when both are B."""
    (a, b, c), (_, d, e), (_, _, f) = B.tolist()
    (p, q, r), (_, s, t), (_, _, u) = B_dot.tolist()
    aa = d * u + s * f - 2.0 * e * t
    ab = c * t + r * e - b * u - q * f
    ac = b * t + q * e - c * s - r * d
    bb = a * u + p * f - 2.0 * c * r
    bc = b * r + q * c - a * t - p * e
    cc = a * s + p * d - 2.0 * b * q
    return np.array(((aa, ab, ac), (ab, bb, bc), (ac, bc, cc)))
