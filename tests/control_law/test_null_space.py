from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from control_law.adjugate import gram_adjugate
from control_law.null_space import manipulability, null_space_velocity, project

FloatArray = npt.NDArray[np.float64]


REGULARISATION = 1e-4


def pseudo_inverse_null_space_velocity(
    J: FloatArray, J_dot: FloatArray, g: FloatArray, g_dot: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(4) and its derivative by d(J⁺J)/dt = J⁺J̇N + (J⁺J̇N)ᵀ, valid for J of full rank."""
    pinv = J.T @ np.linalg.inv(J @ J.T)
    N = np.eye(len(g)) - pinv @ J
    zeta = N @ g
    zeta_dot = -pinv @ (J_dot @ zeta) - N @ (J_dot.T @ (pinv.T @ g)) + N @ g_dot
    return zeta, zeta_dot


def wish(t: float, n: int) -> tuple[FloatArray, FloatArray]:
    """Some g(t) and its ġ(t)."""
    k = np.arange(1, n + 1)
    return np.sin(k * t + k), k * np.cos(k * t + k)


def along(
    chain: Any, motion: Any, t: float, regularisation: float
) -> tuple[Any, FloatArray, FloatArray]:
    terms = chain.terms(*motion(t))
    return terms, *null_space_velocity(terms.J, terms.J_dot, *wish(t, chain.joints), regularisation)


@pytest.mark.parametrize("seed", range(5))
def test_the_end_effector_does_not_see_it(
    redundant: Any, random_motion: Callable[..., Any], seed: int
) -> None:
    terms, zeta, zeta_dot = along(
        redundant, random_motion(seed, redundant.joints), 0.4, REGULARISATION
    )
    assert np.linalg.norm(zeta) > 1e-6
    J, J_dot = terms.J, terms.J_dot
    scale = np.linalg.norm(J) * np.linalg.norm(wish(0.4, redundant.joints)[0])
    assert np.linalg.norm(J @ zeta) <= 1e-14 * scale
    rate_scale = np.linalg.norm(J) * np.linalg.norm(zeta_dot) + np.linalg.norm(J_dot @ zeta)
    assert np.linalg.norm(J @ zeta_dot + J_dot @ zeta) <= 1e-13 * max(rate_scale, scale)


@given(
    st.integers(2, 3).flatmap(
        lambda z: st.integers(z + 1, 7).flatmap(
            lambda n: arrays(np.float64, (z + 1, n), elements=st.floats(-1.0, 1.0))
        )
    )
)
def test_the_end_effector_does_not_see_it_at_any_jacobian(rows: FloatArray) -> None:
    J, g = rows[:-1], rows[-1]
    zeta, _ = null_space_velocity(J, np.zeros_like(J), g, np.zeros_like(g), 1e-3)
    # Rounding of w and adj(JJᵀ) is relative to their largest possible size.
    size = np.linalg.norm(J) ** (2 * len(J)) / (manipulability(J) + 1e-3)
    assert np.linalg.norm(J @ zeta) <= 1e-14 * np.linalg.norm(J) * np.linalg.norm(g) * (1 + size)
    assert np.linalg.norm(zeta) <= np.linalg.norm(g) * (1 + 1e-12 * (1 + size))


@pytest.mark.parametrize("seed", range(5))
def test_unregularised_it_is_the_papers(
    redundant: Any, random_motion: Callable[..., Any], seed: int
) -> None:
    motion = random_motion(seed, redundant.joints)
    terms, zeta, zeta_dot = along(redundant, motion, 0.4, 0.0)
    assert manipulability(terms.J) > 1e-5
    g, g_dot = wish(0.4, redundant.joints)
    expected, expected_dot = pseudo_inverse_null_space_velocity(terms.J, terms.J_dot, g, g_dot)
    np.testing.assert_allclose(zeta, expected, atol=1e-10)
    np.testing.assert_allclose(zeta_dot, expected_dot, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(project(terms.J, g), expected, atol=1e-10)


@pytest.mark.parametrize("regularisation", [0.0, REGULARISATION])
@pytest.mark.parametrize("seed", range(3))
def test_its_rate_is_its_derivative(
    redundant: Any, random_motion: Callable[..., Any], seed: int, regularisation: float
) -> None:
    motion, t, h = random_motion(seed, redundant.joints), 0.4, 1e-6
    _, _, zeta_dot = along(redundant, motion, t, regularisation)
    before = along(redundant, motion, t - h, regularisation)[1]
    after = along(redundant, motion, t + h, regularisation)[1]
    np.testing.assert_allclose(zeta_dot, (after - before) / (2 * h), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("offset_s", [-0.3, -1e-2, -1e-4, 0.0, 1e-5, 1e-3, 0.1])
def test_it_passes_through_a_singularity(
    planar_chain: Callable[..., Any], motion: Any, offset_s: float
) -> None:
    chain, h = planar_chain(3), 1e-6
    # At t = 0 joints 2 and 3 are at zero: the arm is straight.
    through = motion(
        np.array([0.3, 0.0, 0.0]), np.array([0.5, 0.6, 0.4]), np.array([1.0, 2.0, 1.5]), np.zeros(3)
    )
    terms, zeta, zeta_dot = along(chain, through, offset_s, REGULARISATION)
    before = along(chain, through, offset_s - h, REGULARISATION)[1]
    after = along(chain, through, offset_s + h, REGULARISATION)[1]
    np.testing.assert_allclose(zeta_dot, (after - before) / (2 * h), rtol=1e-6, atol=1e-6)
    assert np.linalg.norm(terms.J @ zeta) < 1e-12
    if offset_s == 0.0:
        np.testing.assert_allclose(zeta, 0.0, atol=1e-12)


def test_the_papers_projector_has_no_value_at_a_singularity() -> None:
    J = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    with pytest.raises(ZeroDivisionError):
        project(J, np.ones(3))
    np.testing.assert_array_equal(project(J, np.ones(3), 1e-3), 0.0)


def test_projecting_reduces_by_w_over_w_plus_regularisation(
    redundant: Any, random_motion: Callable[..., Any]
) -> None:
    terms = redundant.terms(*random_motion(3, redundant.joints)(0.0))
    v, w = np.ones(redundant.joints), manipulability(terms.J)
    np.testing.assert_allclose(
        project(terms.J, v, 1e-3), w / (w + 1e-3) * project(terms.J, v), rtol=1e-9, atol=1e-12
    )


def test_manipulability_of_a_3r_arm(planar_chain: Callable[..., Any]) -> None:
    L, (_, q2, q3) = 0.38, (0.2, 0.9, -1.4)
    s2, s3, s23 = np.sin(q2), np.sin(q3), np.sin(q2 + q3)
    J = planar_chain(3).terms(np.array([0.2, q2, q3]), np.zeros(3)).J
    np.testing.assert_allclose(
        manipulability(J), L**4 * (s3**2 + (s23 + s3) ** 2 + (s2 + s23) ** 2)
    )


@pytest.mark.parametrize("z", [2, 3])
def test_adjugate_times_gram_is_the_determinant(z: int) -> None:
    J = np.random.default_rng(z).normal(size=(z, 5))
    w, adjugate = gram_adjugate((J @ J.T).tolist())
    np.testing.assert_allclose(np.array(adjugate) @ J @ J.T, w * np.eye(z), atol=1e-10)
    np.testing.assert_allclose(w, np.linalg.det(J @ J.T))


@pytest.mark.parametrize("z", [1, 4])
def test_refuses_other_task_dimensions(z: int) -> None:
    with pytest.raises(ValueError, match=f"dimension {z}"):
        manipulability(np.ones((z, 5)))
