"""What follows from joint angles alone: in no row, worked out from them where people ask for it."""

import numpy as np
import numpy.typing as npt

from hardware.robot_model import RobotModel
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import Session
from telemetry.rows import Derive, DerivedColumns

FloatArray = npt.NDArray[np.float64]


def derivation(session: Session) -> Derive:
    """Return what works out the derived columns of both sites' rows; any thread may use it."""
    arms = {site.label: ArmRows(robot_of(session, site)) for site in SiteId}
    center_m = np.zeros((len(session.remote.obstacles), 3))
    for center, obstacle in zip(center_m, session.remote.obstacles, strict=True):
        center[: len(obstacle.center_m)] = obstacle.center_m  # in the plane: in that of the base
    obstacles_m = {SiteId.LOCAL.label: center_m[:0], SiteId.REMOTE.label: center_m}

    def derive(site: str, q: FloatArray) -> DerivedColumns:
        arm = arms[site]
        origins_m, axes = arm.pose(q)
        link_m, midpoint_m = distance_rows(origins_m, obstacles_m[site])
        return {
            "manipulability": manipulability_rows(origins_m, axes, arm.task_dimension),
            "link_distance_m": link_m,
            "midpoint_distance_m": midpoint_m,
        }

    return derive


class ArmRows:
    """An arm along rows of joint angles, all rows at once: rows are the last axis everywhere."""

    def __init__(self, robot: RobotModel) -> None:
        rest = np.zeros(robot.joints)
        terms = robot.terms(rest, rest)
        self.task_dimension = robot.task_dimension
        self._origins_m, self._axes = terms.origins, terms.axes

    def pose(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return origins (n + 1, 3, r) [m] and axes (n, 3, r), as in `RobotTerms`, at q (r, n).

        A product of exponentials: each joint turns what comes after it at q = 0.
        """
        r, n = q.shape
        origins_m, axes = np.empty((n + 1, 3, r)), np.empty((n, 3, r))
        R, t = np.repeat(np.eye(3)[..., np.newaxis], r, axis=2), np.zeros((3, r))
        with np.errstate(invalid="ignore"):  # a reading that led to a fault is as it was read
            sin, cos = np.sin(q.T), np.cos(q.T)
        for i, axis in enumerate(self._axes):
            origin_m = self._origins_m[i]
            origins_m[i], axes[i] = _turned(R, origin_m) + t, _turned(R, axis)
            cross = np.cross(np.eye(3), axis)  # cross @ v = axis × v
            R = R + sin[i] * _turned(R, cross) + (1.0 - cos[i]) * _turned(R, cross @ cross)
            t = origins_m[i] - _turned(R, origin_m)
        origins_m[n] = _turned(R, self._origins_m[n]) + t
        return origins_m, axes


def manipulability_rows(origins_m: FloatArray, axes: FloatArray, z: int) -> FloatArray:
    """Return det(JJᵀ) (r,) of the first z task axes, J's columns being a × (X − o)."""
    columns = np.cross(axes, origins_m[-1] - origins_m[:-1], axis=1)[:, :z]
    G = np.einsum("nir,njr->ijr", columns, columns)
    w: FloatArray
    if z == 2:
        w = G[0, 0] * G[1, 1] - G[0, 1] * G[1, 0]
    else:
        w = np.sum(G[0] * np.cross(G[1], G[2], axis=0), axis=0)
    return w


def distance_rows(origins_m: FloatArray, centers_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how near links, and their midpoints, come to any centre (k, 3): (r,) [m] each.

    NaN without a centre.
    """
    nearest_m = np.full((2, origins_m.shape[2]), np.nan)
    links = np.diff(origins_m, axis=0)
    length2 = np.einsum("nir,nir->nr", links, links)
    for center_m in centers_m:
        starts = origins_m[:-1] - center_m[:, np.newaxis]
        along = -np.einsum("nir,nir->nr", starts, links)
        # two joint centres may coincide
        share = np.divide(along, length2, where=length2 > 0.0, out=np.zeros_like(along))
        for i, part in enumerate((share.clip(0.0, 1.0)[:, np.newaxis], 0.5)):
            distance_m = np.linalg.norm(starts + part * links, axis=1).min(axis=0)
            nearest_m[i] = np.fmin(nearest_m[i], distance_m)
    return nearest_m[0], nearest_m[1]


def _turned(R: FloatArray, v: FloatArray) -> FloatArray:
    """Return R v of every R (3, 3, r) and one v, (3,) or (3, 3)."""
    turned: FloatArray = np.einsum("ijr,j...->i...r", R, v)
    return turned
