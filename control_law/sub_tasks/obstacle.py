"""Obstacle avoidance for whole links, bounded everywhere."""

from dataclasses import dataclass, field
from math import sqrt

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import JointPull, center_3d, dot, minus, plus, scaled
from control_law.sub_tasks.obstacle_distance import closest_parameter
from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]

# Within this fraction of the activation distance the push fades to zero at the centre itself,
# where it has no direction; so ġ stays bounded too.
_CORE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SegmentAvoidance:
    """g = −∇ Σ_links (κ/3)(R − d)₊³, d the distance from the centre to the link's segment.

    Centre (3,) [m], or (2,) for an arm in the plane z = 0; activation distance R [m]; gain κ
    [1/(m²·s)]: the pull on a link is at most κR². g is continuous and bounded, and pushes
    outwards at every depth but the very centre, d being rounded there over R/100. ġ is exact, and
    bounded; it jumps only where the closest point passes from a segment's inside to its end, for
    there the distance itself has a kink in its curvature. The main task has priority: this is no
    protection, only a preference.
    """

    center: FloatArray
    activation_distance_m: float
    gain: float
    _center: tuple[float, float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.activation_distance_m > 0:
            raise ValueError(f"activation distance {self.activation_distance_m} m must be positive")
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")
        object.__setattr__(self, "_center", center_3d(self.center))

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,)."""
        joint_pull = JointPull(terms)
        origins, origins_dot = terms.origins.tolist(), terms.origins_dot.tolist()
        core = _CORE * self.activation_distance_m
        for i in range(len(origins) - 1):
            start, link = origins[i], minus(origins[i + 1], origins[i])
            along = closest_parameter(start, link, self._center)
            x = plus(start, link, along)
            offset = minus(x, self._center)
            distance = sqrt(dot(offset, offset) + core * core)
            depth = self.activation_distance_m - distance
            if depth <= 0.0:
                continue
            link_dot = minus(origins_dot[i + 1], origins_dot[i])
            x_dot = plus(origins_dot[i], link_dot, along)
            if 0.0 < along < 1.0:
                # The contact point slides; a link keeps its length, so λ̇ has no other term.
                sliding = -(dot(link_dot, offset) + dot(link, x_dot)) / dot(link, link)
                x_dot = plus(x_dot, link, sliding)
            slope = self.gain * depth * depth / distance  # the pull, −∇V, is slope·offset
            slope_dot = -(2.0 * self.gain * depth + slope) * dot(offset, x_dot) / distance**2
            pull_dot = plus(scaled(slope, x_dot), offset, slope_dot)
            joint_pull.add(i, x, x_dot, scaled(slope, offset), pull_dot)
        return joint_pull.result()
