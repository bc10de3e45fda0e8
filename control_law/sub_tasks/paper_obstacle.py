"""The paper's obstacle avoidance, after its reference [21]."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import JointPull, center_3d, dot, minus, plus, scaled
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
    _center: tuple[float, float, float] = field(init=False, repr=False)

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
        joint_pull = JointPull(terms)
        origins, origins_dot = terms.origins.tolist(), terms.origins_dot.tolist()
        safe2, collision2 = self.safe_radius_m**2, self.collision_radius_m**2
        band = safe2 - collision2
        for link in range(len(origins) - 1):
            x = scaled(0.5, plus(origins[link], origins[link + 1]))
            offset = minus(x, self._center)
            distance2 = dot(offset, offset)
            if not collision2 < distance2 < safe2:
                continue
            x_dot = scaled(0.5, plus(origins_dot[link], origins_dot[link + 1]))
            gap = distance2 - collision2
            scale = -4.0 * self.gain * band / gap**3
            slope = scale * (distance2 - safe2)  # the pull, −κ∇V, is slope·offset
            slope_dot = (scale - 3.0 * slope / gap) * 2.0 * dot(offset, x_dot)
            pull_dot = plus(scaled(slope, x_dot), offset, slope_dot)
            joint_pull.add(link, x, x_dot, scaled(slope, offset), pull_dot)
        return joint_pull.result()
