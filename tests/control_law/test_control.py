from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from control_law.control import control_torque, minus_theta, reference_error
from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.null_space import null_space_velocity
from control_law.sub_tasks.manipulability import ManipulabilityAscent

TASK_DAMPING = (0.0, 4.0)


@pytest.mark.parametrize("task_damping", TASK_DAMPING)
@pytest.mark.parametrize("seed", range(3))
def test_the_closed_loop_is_7(
    redundant: Any, random_motion: Callable[..., Any], seed: int, task_damping: float
) -> None:
    """Mṡ + Cs = τ_e − JᵀΩP(e) − Λs once (6) is put into (1)."""
    chain, rng = redundant, np.random.default_rng(seed)
    terms = chain.terms(*random_motion(seed, chain.joints)(0.3))
    z = len(terms.X)
    coupling = Coupling.from_stiffness(np.full(z, 50.0), np.full(z, 5.0))
    damping = Damping(rng.uniform(0.5, 2.0, chain.joints), np.full(z, task_damping))
    force, tau_e = coupling.force(rng.normal(size=z)), rng.normal(size=chain.joints)
    zeta, zeta_dot = null_space_velocity(
        terms.J, terms.J_dot, *ManipulabilityAscent(20.0).evaluate(terms), 1e-4
    )
    torque, s = control_torque(terms, force, damping, zeta, zeta_dot)

    q_ddot = np.linalg.solve(terms.M, torque + tau_e - terms.C @ terms.q_dot - terms.G)
    s_dot = q_ddot - zeta_dot
    np.testing.assert_allclose(
        terms.M @ s_dot + terms.C @ s,
        tau_e - terms.J.T @ force - damping.matrix(terms.J) @ s,
        atol=1e-10,
    )
    np.testing.assert_array_equal(s, reference_error(terms.q_dot, zeta))
    np.testing.assert_allclose(terms.J @ s, terms.X_dot, atol=1e-13)  # Jζ = 0: Ẋ = Js


def test_without_sub_task_it_is_the_papers_local_controller(
    planar_chain: Callable[..., Any], random_motion: Callable[..., Any]
) -> None:
    terms = planar_chain(2).terms(*random_motion(0, 2)(0.0))
    e, still = np.array([0.3, -0.7]), np.zeros(2)
    coupling = Coupling.paper(np.ones(2), np.ones(2))
    torque, s = control_torque(
        terms, coupling.force(e), Damping(np.full(2, 0.94), np.zeros(2)), still, still
    )
    np.testing.assert_allclose(
        torque, terms.G - terms.J.T @ np.arctan(e) - 0.94 * terms.q_dot, atol=1e-14
    )  # (22)
    np.testing.assert_array_equal(s, terms.q_dot)


def test_theta_is_5(planar_chain: Callable[..., Any], random_motion: Callable[..., Any]) -> None:
    terms = planar_chain(3).terms(*random_motion(0, 3)(0.0))
    zeta, zeta_dot = np.array([0.1, 0.2, -0.3]), np.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose(
        -minus_theta(terms.M, terms.C, terms.G, zeta, zeta_dot),
        -terms.M @ zeta_dot - terms.C @ zeta - terms.G,
    )
