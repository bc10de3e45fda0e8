"""Climb the manipulability index."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.adjugate import gram_adjugate_rate, split_gram
from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ManipulabilityAscent:
    """g = κ ∂w/∂q, w = det(JJᵀ): the negative gradient of −κw, smooth at every pose.

    Gain κ in rad/s per unit of w (m⁴ for two task axes, m⁶ for three).
    """

    gain: float

    def __post_init__(self) -> None:
        if not self.gain >= 0:
            raise ValueError(f"gain {self.gain} must be zero or more")

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n).

        With P = adj(JJᵀ)J, ∂w/∂q_i = 2 Σ_k ∂_iJ_k·P_k, and ∂_iJ_k = a_i×J_k for i ≤ k,
        a_k×J_i for k < i.
        """
        z, n = terms.J.shape
        rows = np.concatenate((terms.J_xyz, terms.J_xyz_dot))
        products = rows.dot(rows.T).tolist()
        _, _, adjugate, adjugate_dot = gram_adjugate_rate(*split_gram(products, z, 3))
        mixed = np.zeros((6, 6))
        mixed[:z, :z] = mixed[3 : 3 + z, 3 : 3 + z] = adjugate
        mixed[3 : 3 + z, :z] = adjugate_dot
        columns = mixed.dot(rows).T.tolist()  # of P and Ṗ

        slope, slope_dot, joints = [], [], []
        tx = ty = tz = ux = uy = uz = 0.0  # T = Σ_{k<i} P_k×a_k, U = Ṫ
        for (ax, ay, az), (bx, by, bz), (jx, jy, jz, kx, ky, kz), (px, py, pz, rx, ry, rz) in zip(
            terms.axes.tolist(), terms.axes_dot.tolist(), rows.T.tolist(), columns, strict=True
        ):
            slope.append(jx * tx + jy * ty + jz * tz)
            slope_dot.append(kx * tx + ky * ty + kz * tz + jx * ux + jy * uy + jz * uz)
            tx, ty, tz = tx + py * az - pz * ay, ty + pz * ax - px * az, tz + px * ay - py * ax
            ux += ry * az - rz * ay + py * bz - pz * by
            uy += rz * ax - rx * az + pz * bx - px * bz
            uz += rx * ay - ry * ax + px * by - py * bx
            joints.append((ax, ay, az, bx, by, bz, jx, jy, jz, kx, ky, kz, px, py, pz, rx, ry, rz))
        tx = ty = tz = ux = uy = uz = 0.0  # T = Σ_{k≥i} J_k×P_k, U = Ṫ
        for i in reversed(range(n)):
            ax, ay, az, bx, by, bz, jx, jy, jz, kx, ky, kz, px, py, pz, rx, ry, rz = joints[i]
            tx, ty, tz = tx + jy * pz - jz * py, ty + jz * px - jx * pz, tz + jx * py - jy * px
            ux += ky * pz - kz * py + jy * rz - jz * ry
            uy += kz * px - kx * pz + jz * rx - jx * rz
            uz += kx * py - ky * px + jx * ry - jy * rx
            slope[i] += ax * tx + ay * ty + az * tz
            slope_dot[i] += bx * tx + by * ty + bz * tz + ax * ux + ay * uy + az * uz
        result = np.array((slope, slope_dot))
        result *= 2.0 * self.gain
        return result
