"""Kinematics of a revolute chain that several sub-tasks share."""

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]

_NEXT = np.array((1, 2, 0))


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a×b along the last axis, (..., 3); np.cross costs several times more."""
    swapped: FloatArray = a * b.take(_NEXT, -1)
    swapped -= a.take(_NEXT, -1) * b
    return swapped.take(_NEXT, -1)


def row_dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the dot products of matching rows, (r,)."""
    products: FloatArray = np.einsum("ij,ij->i", a, b)
    return products


def from_here_on(rows: FloatArray) -> FloatArray:
    """Return Σ_{k≥i} rows_k along the last axis but one."""
    return rows[..., ::-1, :].cumsum(-2)[..., ::-1, :]


def pulled_joints(
    terms: Terms,
    points: FloatArray,
    points_dot: FloatArray,
    pull: FloatArray,
    pull_dot: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return g = Σ_i J_iᵀ φ_i and ġ, (n,), for a pull φ_i at a point x_i of every link i.

    All arguments (n, 3). Column k of J_i is a_k×(x_i − o_k) for k ≤ i, so that
    g_k = a_k·Σ_{i≥k}(x_i − o_k)×φ_i. A point may slide along its link; its velocity then
    counts the sliding.
    """
    moment, moment_a, moment_b = cross(
        np.array((points, points_dot, points)), np.array((pull, pull, pull_dot))
    )
    totals = from_here_on(np.array((pull, pull_dot, moment, moment_a + moment_b)))
    force, force_dot, torque, torque_dot = totals
    origins, origins_dot = terms.origins[:-1], terms.origins_dot[:-1]
    lever, lever_a, lever_b = cross(
        np.array((origins, origins_dot, origins)), np.array((force, force, force_dot))
    )
    about = torque - lever
    g = row_dot(terms.axes, about)
    g_dot = row_dot(terms.axes_dot, about) + row_dot(terms.axes, torque_dot - lever_a - lever_b)
    return g, g_dot


def center_3d(center: FloatArray) -> FloatArray:
    """Return a centre (3,) from (3,) or from (2,), which lies in the plane of the base."""
    if center.shape == (2,):
        return np.append(center, 0.0)
    if center.shape == (3,):
        return center
    raise ValueError(f"center {center} must have 2 or 3 coordinates")
