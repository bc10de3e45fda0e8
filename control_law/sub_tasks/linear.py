"""The paper's first sub-task: one linear combination of the joints is brought to zero."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LinearSingularityAvoidance:
    """g = −κ(aᵀq)a, the negative gradient of (κ/2)(aᵀq)². The paper: κ = 0.01, a = [1, −2, 1].

    Gain κ [1/s], direction a (n,). It keeps the 3R arm bent by rule of thumb: the index
    det(JJᵀ) depends on neither q₁ nor this sum. `ManipulabilityAscent` climbs the index itself.
    """

    gain: float
    direction: FloatArray

    def __post_init__(self) -> None:
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n)."""
        a = self.direction
        return np.array(((-self.gain * a.dot(terms.q)) * a, (-self.gain * a.dot(terms.q_dot)) * a))
