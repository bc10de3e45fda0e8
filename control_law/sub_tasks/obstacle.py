"""Obstacle avoidance for whole links, bounded everywhere."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import center_3d, pulled_joints, row_dot
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
    outwards at every depth. ġ is exact, and bounded; it jumps only where the closest point
    passes from a segment's inside to its end, for there the distance itself has a kink in its
    curvature. The main task has priority: this is no protection, only a preference.
    """

    center: FloatArray
    activation_distance_m: float
    gain: float
    _center: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.activation_distance_m > 0:
            raise ValueError(f"activation distance {self.activation_distance_m} m must be positive")
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")
        object.__setattr__(self, "_center", center_3d(self.center))

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,)."""
        starts, links = terms.origins[:-1], np.diff(terms.origins, axis=0)
        along = closest_parameter(terms.origins, self._center)
        points = starts + along[:, None] * links
        offset = points - self._center
        core = _CORE * self.activation_distance_m
        distance = np.sqrt(row_dot(offset, offset) + core * core)
        depth = self.activation_distance_m - distance
        if not (depth > 0).any():
            return np.zeros_like(distance), np.zeros_like(distance)
        depth = depth.clip(0.0)

        starts_dot, links_dot = terms.origins_dot[:-1], np.diff(terms.origins_dot, axis=0)
        points_dot = starts_dot + along[:, None] * links_dot
        # The contact point slides along its link; a link's length is constant, so λ̇ has one term.
        slides = (along > 0.0) & (along < 1.0)
        sliding = -(row_dot(links_dot, offset) + row_dot(links, points_dot))
        along_dot = np.where(slides, sliding / np.where(slides, row_dot(links, links), 1.0), 0.0)
        points_dot += along_dot[:, None] * links

        slope = self.gain * depth * depth / distance  # pull = −∇V = slope·offset
        curvature = -(2.0 * self.gain * depth + slope) / (distance * distance)
        pull = slope[:, None] * offset
        growth = curvature * row_dot(offset, points_dot)
        pull_dot = slope[:, None] * points_dot + growth[:, None] * offset
        return pulled_joints(terms, points, points_dot, pull, pull_dot)
