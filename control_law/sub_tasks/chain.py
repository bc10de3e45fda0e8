"""Kinematics of a revolute chain that several sub-tasks share.

Vectors are plain three-tuples or lists, and products are written out: for a handful of joints they
cost a fraction of arrays, or of functions.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]
Vector = Sequence[float]  # of three


class JointPull:
    """g = Σ J_iᵀφ_i and ġ, gathered from pulls φ_i at points x_i of the links."""

    def __init__(self, joints: int) -> None:
        self._g = [0.0] * joints
        self._g_dot = [0.0] * joints
        self._joints: list[tuple[Vector, Vector, Vector, Vector]] = []

    def add(
        self, terms: Terms, link: int, x: Vector, x_dot: Vector, pull: Vector, pull_dot: Vector
    ) -> None:
        """Add a pull φ, φ̇ at a point x, ẋ of a link, counted from 0.

        Column k of J is a_k×(x − o_k), k ≤ link. If x slides along the link, ẋ counts the sliding.
        """
        if not self._joints:  # most of the time nothing pulls
            self._joints = list(
                zip(
                    terms.axes.tolist(),
                    terms.axes_dot.tolist(),
                    terms.origins.tolist(),
                    terms.origins_dot.tolist(),
                    strict=False,  # the last origin is the end effector
                )
            )
        (x0, x1, x2), (v0, v1, v2) = x, x_dot
        (p0, p1, p2), (r0, r1, r2) = pull, pull_dot
        for k, ((a0, a1, a2), (b0, b1, b2), (o0, o1, o2), (u0, u1, u2)) in enumerate(
            self._joints[: link + 1]
        ):
            d0, d1, d2 = x0 - o0, x1 - o1, x2 - o2
            e0, e1, e2 = v0 - u0, v1 - u1, v2 - u2
            # column a×d, column_dot ȧ×d + a×ḋ
            c0, c1, c2 = a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0
            s0 = b1 * d2 - b2 * d1 + a1 * e2 - a2 * e1
            s1 = b2 * d0 - b0 * d2 + a2 * e0 - a0 * e2
            s2 = b0 * d1 - b1 * d0 + a0 * e1 - a1 * e0
            self._g[k] += c0 * p0 + c1 * p1 + c2 * p2
            self._g_dot[k] += s0 * p0 + s1 * p1 + s2 * p2 + c0 * r0 + c1 * r1 + c2 * r2

    def result(self) -> FloatArray:
        """Return g and ġ, (2, n)."""
        return np.array((self._g, self._g_dot))


def center_3d(center: FloatArray) -> tuple[float, float, float]:
    """Return a centre of three coordinates from (3,), or from (2,): in the plane of the base."""
    if center.shape not in ((2,), (3,)):
        raise ValueError(f"center {center} must have 2 or 3 coordinates")
    x, y, z = (*center.tolist(), 0.0)[:3]
    return x, y, z
