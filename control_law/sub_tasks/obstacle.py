"""Obstacle avoidance for whole links, bounded everywhere."""

from dataclasses import dataclass, field
from itertools import pairwise
from math import sqrt

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.chain import JointPull, center_3d
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

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n)."""
        joint_pull = JointPull(len(terms.q))
        cx, cy, cz = self._center
        reach = self.activation_distance_m
        core2 = (_CORE * reach) ** 2
        points = terms.origins.tolist()
        for i, ((ax, ay, az), (bx, by, bz)) in enumerate(pairwise(points)):
            lx, ly, lz = bx - ax, by - ay, bz - az
            along = _closest_parameter(ax - cx, ay - cy, az - cz, lx, ly, lz)
            x, y, z = ax + along * lx, ay + along * ly, az + along * lz
            ox, oy, oz = x - cx, y - cy, z - cz
            distance2 = ox * ox + oy * oy + oz * oz + core2
            if distance2 >= reach * reach:
                continue
            (ux, uy, uz), (vx, vy, vz) = terms.origins_dot[i : i + 2].tolist()
            mx, my, mz = vx - ux, vy - uy, vz - uz  # of the link
            vx, vy, vz = ux + along * mx, uy + along * my, uz + along * mz  # of the point
            if 0.0 < along < 1.0:
                # The contact point slides; a link keeps its length, so λ̇ has no other term.
                sliding = -(mx * ox + my * oy + mz * oz + lx * vx + ly * vy + lz * vz)
                sliding /= lx * lx + ly * ly + lz * lz
                vx, vy, vz = vx + sliding * lx, vy + sliding * ly, vz + sliding * lz
            distance = sqrt(distance2)
            depth = reach - distance
            slope = self.gain * depth * depth / distance  # the pull, −∇V, is slope·offset
            toward = ox * vx + oy * vy + oz * vz
            slope_dot = -(2.0 * self.gain * depth + slope) * toward / distance2
            joint_pull.add(
                terms,
                i,
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


def _closest_parameter(sx: float, sy: float, sz: float, lx: float, ly: float, lz: float) -> float:
    """Return λ in [0, 1] that brings s + λl nearest to 0: s a link's start from a centre, l it."""
    length2 = lx * lx + ly * ly + lz * lz
    if length2 == 0.0:  # two joint centres may coincide
        return 0.0
    along = -(lx * sx + ly * sy + lz * sz) / length2
    return 0.0 if along <= 0.0 else min(along, 1.0)
