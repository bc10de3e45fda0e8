"""Self-motion: joint velocities that the end effector does not see."""

from operator import add

import numpy as np
import numpy.typing as npt

from control_law.adjugate import gram_adjugate, gram_adjugate_rate, split_gram, times

FloatArray = npt.NDArray[np.float64]
_NONE = (0.0, 0.0, 0.0)


def manipulability(J: FloatArray) -> float:
    """Return w = det(JJᵀ), the paper's manipulability index (Section VI)."""
    w, _ = gram_adjugate(J.dot(J.T).tolist())
    return w


def project(J: FloatArray, v: FloatArray, regularisation: float = 0.0) -> FloatArray:
    """Return w/(w+ε)·(I − J⁺J) v, (n,), ε the regularisation; with v = s this is the STE of (21).

    It lies in the null space of J at every pose. ε = 0 is the paper's projector, which has no
    value where w = 0 (ZeroDivisionError).
    """
    w, adjugate = gram_adjugate(J.dot(J.T).tolist())
    scale = 1.0 / (w + regularisation)
    y = times(adjugate, J.dot(v).tolist())
    result: FloatArray = (w * v - np.array(y).dot(J)) * scale
    return result


def null_space_velocity(
    J: FloatArray, J_dot: FloatArray, g: FloatArray, g_dot: FloatArray, regularisation: float
) -> tuple[FloatArray, FloatArray]:
    """Return ζ = [wI − Jᵀ adj(JJᵀ) J] g/(w+ε) and ζ̇, both (n,), w = det(JJᵀ).

    This is w/(w+ε) times ζ of (4): Jζ = 0 at every pose, so the theorems hold as they stand,
    and it goes smoothly to zero at a singularity, where (4) has no value. A damped
    pseudo-inverse would leave Jζ ≠ 0. ε ≥ 0 in the unit of w, about 1e-3 of its largest value;
    ε = 0 is exactly (4) and raises ZeroDivisionError where w = 0.
    """
    z, n = J.shape
    # One product gives all that J, J̇, g and ġ have in common, another puts them together again:
    # two calls instead of some twenty.
    rows = np.empty((2 * z + 2, n))
    rows[:z], rows[z:-2], rows[-2], rows[-1] = J, J_dot, g, g_dot
    products = rows.dot(rows.T).tolist()
    w, w_dot, adjugate, adjugate_dot = gram_adjugate_rate(*split_gram(products, z, z))
    J_g, J_dot_g = products[-2][:z], products[-2][z:-2]
    y = times(adjugate, J_g)
    # ẏ: the rates of adj(JJᵀ), of J and of g, one after the other
    y_dot = map(add, times(adjugate_dot, J_g), times(adjugate, [*map(add, J_dot_g, products[-1])]))
    # ζ = (wg − Jᵀy)/(w+ε),  ζ̇ = (ẇg + wġ − J̇ᵀy − Jᵀẏ − ẇζ)/(w+ε)
    scale = 1.0 / (w + regularisation)
    fall = w_dot * scale
    minus_y = [-scale * a for a in y]
    shares = (
        (*minus_y, *_NONE[:z], scale * w, 0.0),
        (
            *[scale * (fall * a - b) for a, b in zip(y, y_dot, strict=True)],
            *minus_y,
            scale * (w_dot - fall * w),
            scale * w,
        ),
    )
    zeta, zeta_dot = np.array(shares).dot(rows)
    return zeta, zeta_dot
