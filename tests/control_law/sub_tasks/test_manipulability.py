from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from control_law.null_space import manipulability
from control_law.sub_tasks.manipulability import ManipulabilityAscent


@pytest.mark.parametrize("seed", range(5))
def test_climbs_the_index(
    redundant: Any, random_motion: Callable[..., Any], check_gradient: Callable[..., Any], seed: int
) -> None:
    q, _ = random_motion(seed, redundant.joints)(0.0)
    g = check_gradient(
        ManipulabilityAscent(20.0), redundant, q, lambda terms: -20.0 * manipulability(terms.J)
    )
    assert np.linalg.norm(g) > 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_rate(
    redundant: Any, random_motion: Callable[..., Any], check_rate: Callable[..., Any], seed: int
) -> None:
    check_rate(ManipulabilityAscent(20.0), redundant, random_motion(seed, redundant.joints), 0.5)


def test_is_the_textbook_gradient_of_a_3r_arm(planar_chain: Callable[..., Any]) -> None:
    L, q2, q3 = 0.38, 0.9, -1.4
    s2, s3, s23 = np.sin(q2), np.sin(q3), np.sin(q2 + q3)
    c2, c3, c23 = np.cos(q2), np.cos(q3), np.cos(q2 + q3)
    expected = 2 * L**4 * np.array([
        0.0,
        (s23 + s3) * c23 + (s2 + s23) * (c2 + c23),
        s3 * c3 + (s23 + s3) * (c23 + c3) + (s2 + s23) * c23,
    ])  # fmt: skip
    terms = planar_chain(3).terms(np.array([2.2, q2, q3]), np.zeros(3))
    g, _ = ManipulabilityAscent(1.0).evaluate(terms)
    np.testing.assert_allclose(g, expected, atol=1e-15)


def test_is_at_rest_at_a_singularity_but_not_stuck_next_to_it(
    planar_chain: Callable[..., Any],
) -> None:
    chain = planar_chain(3)
    at, _ = ManipulabilityAscent(1.0).evaluate(chain.terms(np.zeros(3), np.zeros(3)))
    near, _ = ManipulabilityAscent(1.0).evaluate(
        chain.terms(np.array([0.0, 1e-3, 1e-3]), np.zeros(3))
    )
    np.testing.assert_allclose(at, 0.0, atol=1e-15)
    assert near[1] > 0


def test_refuses_a_gain_that_descends() -> None:
    with pytest.raises(ValueError, match="gain"):
        ManipulabilityAscent(-1.0)
