"""The paper's obstacle avoidance, after its reference [21]."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import center_3d, pulled_joints, row_dot
from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StipanovicAvoidance:
    """g = −κ Σ J_iᵀ∇V(x_i) at the midpoints of all links, as in the paper's Fig. 3.

    V = min(0, (ρ−R²)/(ρ−r²))², ρ the squared distance to the centre: it acts between the
    collision radius r and the safe radius R [m]. Centre (3,) [m], or (2,) for an arm in the
    plane z = 0. Kept to reproduce the paper, and hazardous: without bound as ρ → r², nothing at
    all inside r, a jump of ġ at R, and only midpoints count. Use `SegmentAvoidance` elsewhere.
    """

    center: FloatArray
    safe_radius_m: float
    collision_radius_m: float
    gain: float
    _center: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.collision_radius_m < self.safe_radius_m:
            raise ValueError(
                f"collision radius {self.collision_radius_m} m must be positive "
                f"and below the safe radius {self.safe_radius_m} m"
            )
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")
        object.__setattr__(self, "_center", center_3d(self.center))

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,)."""
        points = 0.5 * (terms.origins[1:] + terms.origins[:-1])
        offset = points - self._center
        distance2 = row_dot(offset, offset)
        safe2, collision2 = self.safe_radius_m**2, self.collision_radius_m**2
        acts = (distance2 > collision2) & (distance2 < safe2)
        if not acts.any():
            return np.zeros_like(distance2), np.zeros_like(distance2)
        points_dot = 0.5 * (terms.origins_dot[1:] + terms.origins_dot[:-1])
        gap = np.where(acts, distance2 - collision2, 1.0)
        depth = np.where(acts, distance2 - safe2, 0.0)
        band = safe2 - collision2
        scale = -4.0 * self.gain * band / gap**3
        slope = scale * depth  # pull = −κ∇V = slope·offset
        curvature = np.where(acts, scale - 3.0 * slope / gap, 0.0)  # d slope / d distance²
        pull = slope[:, None] * offset
        growth = 2.0 * curvature * row_dot(offset, points_dot)
        pull_dot = slope[:, None] * points_dot + growth[:, None] * offset
        return pulled_joints(terms, points, points_dot, pull, pull_dot)
