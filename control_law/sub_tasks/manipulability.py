"""Climb the manipulability index."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.adjugate import gram_adjugate_rate
from control_law.sub_tasks.chain import Vector, cross, dot, plus
from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ManipulabilityAscent:
    """g = κ ∂w/∂q, w = det(JJᵀ): the negative gradient of −κw, smooth at every pose.

    Gain κ in rad/s per unit of w (m⁴ for two task axes, m⁶ for three).
    """

    gain: float

    def __post_init__(self) -> None:
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,).

        With P = adj(JJᵀ)J, ∂w/∂q_i = 2 Σ_k ∂_iJ_k·P_k, and ∂_iJ_k = a_i×J_k for i ≤ k,
        a_k×J_i for k < i.
        """
        _, _, adjugate, adjugate_dot = gram_adjugate_rate(terms.J, terms.J_dot)
        P = _columns(adjugate @ terms.J)
        P_dot = _columns(adjugate_dot @ terms.J + adjugate @ terms.J_dot)
        axes, axes_dot = terms.axes.tolist(), terms.axes_dot.tolist()
        arms = (terms.origins[-1] - terms.origins[:-1]).tolist()
        arms_dot = (terms.origins_dot[-1] - terms.origins_dot[:-1]).tolist()
        J = [cross(a, r) for a, r in zip(axes, arms, strict=True)]
        J_dot = [
            plus(cross(a_dot, r), cross(a, r_dot))
            for a, a_dot, r, r_dot in zip(axes, axes_dot, arms, arms_dot, strict=True)
        ]

        n = len(axes)
        slope, slope_dot = [0.0] * n, [0.0] * n
        total: Vector = (0.0, 0.0, 0.0)  # Σ_{k<i} P_k×a_k
        total_dot: Vector = total
        for i in range(n):
            slope[i] = dot(J[i], total)
            slope_dot[i] = dot(J_dot[i], total) + dot(J[i], total_dot)
            total = plus(total, cross(P[i], axes[i]))
            total_dot = plus(total_dot, cross(P_dot[i], axes[i]))
            total_dot = plus(total_dot, cross(P[i], axes_dot[i]))
        total = total_dot = (0.0, 0.0, 0.0)  # Σ_{k≥i} J_k×P_k
        for i in reversed(range(n)):
            total = plus(total, cross(J[i], P[i]))
            total_dot = plus(total_dot, cross(J_dot[i], P[i]))
            total_dot = plus(total_dot, cross(J[i], P_dot[i]))
            slope[i] += dot(axes[i], total)
            slope_dot[i] += dot(axes_dot[i], total) + dot(axes[i], total_dot)
        return (2.0 * self.gain) * np.array(slope), (2.0 * self.gain) * np.array(slope_dot)


def _columns(rows: FloatArray) -> list[Vector]:
    """Return the columns of (z, n), with zero along the axes that the task ignores."""
    columns: list[Vector] = rows.T.tolist()
    if len(rows) == 2:
        columns = [(x, y, 0.0) for x, y in columns]
    return columns
