"""Climb the manipulability index."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.adjugate import gram_adjugate_rate
from control_law.sub_tasks.chain import cross, from_here_on, row_dot
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
        z, n = terms.J.shape
        _, _, adjugate, adjugate_dot = gram_adjugate_rate(terms.J, terms.J_dot)
        # Columns as rows of three, so that the cross products also see the axes the task ignores.
        P = np.zeros((n, 3))
        P_dot = np.zeros((n, 3))
        P[:, :z] = (adjugate @ terms.J).T
        P_dot[:, :z] = (adjugate_dot @ terms.J + adjugate @ terms.J_dot).T
        a, a_dot = terms.axes, terms.axes_dot
        arm = terms.origins[-1] - terms.origins[:-1]
        arm_dot = terms.origins_dot[-1] - terms.origins_dot[:-1]
        J, J_dot, turning = cross(np.array((a, a, a_dot)), np.array((arm, arm_dot, arm)))
        J_dot += turning

        products = cross(np.array((J, J_dot, J, P, P_dot, P)), np.array((P, P, P_dot, a, a, a_dot)))
        outer, inner = products[:3], products[3:]
        outer = from_here_on(outer)
        inner = inner.cumsum(-2) - inner  # strictly before i
        slope = row_dot(a, outer[0]) + row_dot(J, inner[0])
        slope_dot = (
            row_dot(a_dot, outer[0])
            + row_dot(a, outer[1] + outer[2])
            + row_dot(J_dot, inner[0])
            + row_dot(J, inner[1] + inner[2])
        )
        return (2.0 * self.gain) * slope, (2.0 * self.gain) * slope_dot
