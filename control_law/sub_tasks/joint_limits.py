"""Stay near the middle of the joint ranges."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class JointCentring:
    """g = −∇f, f = (κ/2) Σ ((q_i − q̄_i)/(q_Mi − q_mi))²; a joint without limits is left alone.

    Limits (n,) [rad], ±inf where there is none; gain κ [rad²/s].
    """

    lower_rad: FloatArray
    upper_rad: FloatArray
    gain: float
    _centre: FloatArray = field(init=False, repr=False)
    _weight: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")
        if self.lower_rad.shape != self.upper_rad.shape or not np.all(
            self.lower_rad < self.upper_rad
        ):
            raise ValueError(
                f"lower limits {self.lower_rad} must lie below the upper {self.upper_rad}"
            )
        limited = np.isfinite(self.lower_rad) & np.isfinite(self.upper_rad)
        lower = np.where(limited, self.lower_rad, 0.0)
        upper = np.where(limited, self.upper_rad, 1.0)
        weight = np.where(limited, self.gain / np.square(upper - lower), 0.0)
        object.__setattr__(self, "_centre", 0.5 * (lower + upper))
        object.__setattr__(self, "_weight", weight)

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n)."""
        return np.array((self._weight * (self._centre - terms.q), -self._weight * terms.q_dot))
