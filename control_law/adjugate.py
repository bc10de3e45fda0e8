"""Determinant and adjugate of JJᵀ with their rates: polynomials, so no pose is singular.

Matrices are nested sequences of plain floats: two or three rows cost a fraction of arrays.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Matrix = Sequence[Sequence[float]]


def gram_adjugate(gram: Matrix) -> tuple[float, Matrix]:
    """Return w = det(B) and adj(B) of B = JJᵀ, (z, z), for z = 2 or 3."""
    if len(gram) == 2:
        (a, b), (_, d) = gram
        return a * d - b * b, ((d, -b), (-b, a))
    if len(gram) == 3:
        (a, b, c), (_, d, e), (_, _, f) = gram
        aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
        bc = b * c - a * e
        adjugate = ((aa, ab, ac), (ab, a * f - c * c, bc), (ac, bc, a * d - b * b))
        return a * aa + b * ab + c * ac, adjugate
    raise ValueError(f"a task of dimension {len(gram)} has no closed form here: use 2 or 3")


def gram_adjugate_rate(gram: Matrix, gram_dot: Matrix) -> tuple[float, float, Matrix, Matrix]:
    """Return w, ẇ, adj(B) and its time derivative from B = JJᵀ and Ḃ, for z = 2 or 3."""
    w, adjugate = gram_adjugate(gram)
    if len(gram) == 2:
        (a, b), (_, d) = gram
        (p, q), (_, s) = gram_dot
        return w, a * s + d * p - 2.0 * b * q, adjugate, ((s, -q), (-q, p))
    (a, b, c), (_, d, e), (_, _, f) = gram
    (p, q, r), (_, s, t), (_, _, u) = gram_dot
    (aa, ab, ac), (_, bb, bc), (_, _, cc) = adjugate
    w_dot = aa * p + bb * s + cc * u + 2.0 * (ab * q + ac * r + bc * t)  # Jacobi's formula
    aa = d * u + s * f - 2.0 * e * t
    ab = c * t + r * e - b * u - q * f
    ac = b * t + q * e - c * s - r * d
    bb = a * u + p * f - 2.0 * c * r
    bc = b * r + q * c - a * t - p * e
    cc = a * s + p * d - 2.0 * b * q
    return w, w_dot, adjugate, ((aa, ab, ac), (ab, bb, bc), (ac, bc, cc))


def split_gram(products: Matrix, z: int, rate_row: int) -> tuple[Matrix, Matrix]:
    """Return B = JJᵀ and Ḃ, (z, z), from the products of rows among each other.

    The first rows are J, those from `rate_row` on J̇.
    """
    if z == 2:
        first, second = products[0], products[1]
        p, q = products[rate_row], products[rate_row + 1]
        r = p[1] + q[0]
        return (first[:2], second[:2]), ((p[0] + p[0], r), (r, q[1] + q[1]))
    gram = [row[:z] for row in products[:z]]
    half = [row[:z] for row in products[rate_row : rate_row + z]]  # J̇Jᵀ
    return gram, [[half[i][j] + half[j][i] for j in range(z)] for i in range(z)]


def times(matrix: Matrix, vector: Sequence[float]) -> Sequence[float]:
    """Return the product of (z, z) and (z,), for z = 2 or 3."""
    if len(vector) == 2:
        (a, b), (c, d) = matrix
        x, y = vector
        return a * x + b * y, c * x + d * y
    (a, b, c), (d, e, f), (g, h, i) = matrix
    x, y, z = vector
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
