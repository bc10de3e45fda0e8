from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from control_law.sub_tasks.linear import LinearSingularityAvoidance

PAPER = LinearSingularityAvoidance(0.01, np.array([1.0, -2.0, 1.0]))


def test_is_the_gradient_of_the_papers_function(
    planar_chain: Callable[..., Any], check_gradient: Callable[..., Any]
) -> None:
    q = np.array([0.4, -1.1, 2.0])
    g = check_gradient(
        PAPER, planar_chain(3), q,
        lambda terms: 0.005 * (terms.q[2] - 2 * terms.q[1] + terms.q[0]) ** 2,
    )  # fmt: skip
    np.testing.assert_allclose(g, -0.01 * 4.6 * np.array([1.0, -2.0, 1.0]))


def test_rate(
    planar_chain: Callable[..., Any],
    random_motion: Callable[..., Any],
    check_rate: Callable[..., Any],
) -> None:
    check_rate(PAPER, planar_chain(3), random_motion(0, 3), 0.5)


def test_refuses_a_gain_that_climbs() -> None:
    with pytest.raises(ValueError, match="gain"):
        LinearSingularityAvoidance(-0.01, np.ones(3))
