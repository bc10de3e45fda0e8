"""The three limits are where a sampled damper on a mass really becomes unstable."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from control_law.damping import Damping
from control_law.sampling import (
    ADVISED_FILTER_RATIO,
    ADVISED_RATIO,
    LIMIT_IMMEDIATE,
    LIMIT_LATE_DIFFERENCE,
    LIMIT_LATE_EXACT,
    damping_ratio,
)


def grows(a: float, difference: bool, late: bool, steps: int = 400) -> bool:
    """Unit mass and period, so that b = a; the force is held over each period."""
    position, velocity, force, previous, pending = 0.0, 1.0, 0.0, -1.0, 0.0
    speeds = []
    for _ in range(steps):
        seen = position - previous if difference else velocity
        force, pending = (pending, -a * seen) if late else (-a * seen, 0.0)
        previous = position
        position, velocity = position + velocity + 0.5 * force, velocity + force
        speeds.append(abs(velocity))
    return max(speeds[steps // 2 :]) > max(speeds[: steps // 2])


@pytest.mark.parametrize(
    ("limit", "difference", "late"),
    [(LIMIT_IMMEDIATE, False, False), (LIMIT_IMMEDIATE, True, False),
     (LIMIT_LATE_EXACT, False, True), (LIMIT_LATE_DIFFERENCE, True, True)],
)  # fmt: skip
def test_limit_is_the_edge(limit: float, difference: bool, late: bool) -> None:
    assert not grows(0.99 * limit, difference, late)
    assert grows(1.01 * limit, difference, late)
    assert 0.5 * limit > ADVISED_RATIO


def test_late_difference_is_0_828() -> None:
    assert pytest.approx(0.828, abs=5e-4) == LIMIT_LATE_DIFFERENCE


def test_a_filtered_velocity_damps_the_advised_mode_without_ringing() -> None:
    """v̇ = −λ v_f, τ_f v̇_f = v − v_f: the poles at λτ_f = ½ are at 45°, the damping ratio 1/√2."""
    filter_s = 0.0038
    rate = ADVISED_FILTER_RATIO / filter_s
    poles = np.linalg.eigvals([[0.0, -rate], [1 / filter_s, -1 / filter_s]])
    np.testing.assert_allclose(-poles.real / np.abs(poles), np.sqrt(0.5))


def test_ratio_is_the_fastest_damped_mode(
    redundant: Any, random_motion: Callable[..., Any]
) -> None:
    terms = redundant.terms(*random_motion(0, redundant.joints)(0.0))
    damping = Damping(np.full(redundant.joints, 0.3), np.full(len(terms.X), 5.0))
    Lambda = damping.matrix(terms.J)
    expected = 1e-3 * np.linalg.eigvals(np.linalg.solve(terms.M, Lambda)).real.max()
    assert damping_ratio(1e-3, terms.M, Lambda) == pytest.approx(expected)


def test_paper_remote_gains_at_a_kilohertz(planar_chain: Callable[..., Any]) -> None:
    chain, rng = planar_chain(3), np.random.default_rng(0)
    Lambda = np.diag([3.19, 3.20, 3.21])
    worst = max(
        damping_ratio(1e-3, chain.terms(q, np.zeros(3)).M, Lambda)
        for q in rng.uniform(-np.pi, np.pi, (2000, 3))
    )
    assert worst == pytest.approx(0.74, abs=0.02)
