"""The paper's obstacle avoidance, after its reference [21]."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import JointPull, center_3d
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

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n)."""
        joint_pull = JointPull(len(terms.q))
        cx, cy, cz = self._center
        safe2, collision2 = self.safe_radius_m**2, self.collision_radius_m**2
        band = safe2 - collision2
        points = terms.origins.tolist()
        for link, ((ax, ay, az), (bx, by, bz)) in enumerate(pairwise(points)):
            x, y, z = 0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz)
            ox, oy, oz = x - cx, y - cy, z - cz
            distance2 = ox * ox + oy * oy + oz * oz
            if not collision2 < distance2 < safe2:
                continue
            (ux, uy, uz), (vx, vy, vz) = terms.origins_dot[link : link + 2].tolist()
            vx, vy, vz = 0.5 * (ux + vx), 0.5 * (uy + vy), 0.5 * (uz + vz)
            gap = distance2 - collision2
            scale = -4.0 * self.gain * band / gap**3
            slope = scale * (distance2 - safe2)  # the pull, −κ∇V, is slope·offset
            slope_dot = (scale - 3.0 * slope / gap) * 2.0 * (ox * vx + oy * vy + oz * vz)
            joint_pull.add(
                terms,
                link,
                (x, y, z),
                (vx, vy, vz),
                (slope * ox, slope * oy, slope * oz),
                (
                    slope * vx + slope_dot * ox,
                    slope * vy + slope_dot * oy,
                    slope * vz + slope_dot * oz,
                ),
            )
        return joint_pull.result()
