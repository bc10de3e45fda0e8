"""Kinematics of a revolute chain that several sub-tasks share.

Vectors are plain three-tuples or lists: for a handful of joints they cost a fraction of arrays.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]
Vector = Sequence[float]  # of three


def dot(a: Vector, b: Vector) -> float:
    """Return a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return a×b."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def plus(a: Vector, b: Vector, scale: float = 1.0) -> Vector:
    """Return a + scale·b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


def scaled(scale: float, a: Vector) -> Vector:
    """Return scale·a."""
    return scale * a[0], scale * a[1], scale * a[2]


def minus(a: Vector, b: Vector) -> Vector:
    """Return a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


class JointPull:
    """g = Σ J_iᵀφ_i and ġ, gathered from pulls φ_i at points x_i of the links."""

    def __init__(self, terms: Terms) -> None:
        self._joints = list(
            zip(
                terms.axes.tolist(),
                terms.axes_dot.tolist(),
                terms.origins.tolist(),
                terms.origins_dot.tolist(),
                strict=False,  # the last origin is the end effector
            )
        )
        self._g = [0.0] * len(self._joints)
        self._g_dot = [0.0] * len(self._joints)

    def add(self, link: int, x: Vector, x_dot: Vector, pull: Vector, pull_dot: Vector) -> None:
        """Add a pull φ, φ̇ at a point x, ẋ of a link, counted from 0.

        Column k of J is a_k×(x − o_k), k ≤ link. If x slides along the link, ẋ counts the sliding.
        """
        for k, (axis, axis_dot, origin, origin_dot) in enumerate(self._joints[: link + 1]):
            arm = minus(x, origin)
            column = cross(axis, arm)
            column_dot = plus(cross(axis_dot, arm), cross(axis, minus(x_dot, origin_dot)))
            self._g[k] += dot(column, pull)
            self._g_dot[k] += dot(column_dot, pull) + dot(column, pull_dot)

    def result(self) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,)."""
        return np.array(self._g), np.array(self._g_dot)


def center_3d(center: FloatArray) -> tuple[float, float, float]:
    """Return a centre of three coordinates from (3,), or from (2,): in the plane of the base."""
    if center.shape not in ((2,), (3,)):
        raise ValueError(f"center {center} must have 2 or 3 coordinates")
    x, y, z = (*center.tolist(), 0.0)[:3]
    return x, y, z
