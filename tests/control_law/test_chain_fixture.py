"""The tests' own robots obey the properties of Section III, else the rest proves nothing."""

from collections.abc import Callable
from typing import Any

import numpy as np


def test_rates_are_the_derivatives(redundant: Any, random_motion: Callable[..., Any]) -> None:
    motion, h = random_motion(1, redundant.joints), 1e-6
    at = redundant.terms(*motion(0.7))
    before, after = redundant.terms(*motion(0.7 - h)), redundant.terms(*motion(0.7 + h))
    for value, rate in [("X", "X_dot"), ("J", "J_dot"), ("origins", "origins_dot"),
                        ("axes", "axes_dot")]:  # fmt: skip
        difference = (getattr(after, value) - getattr(before, value)) / (2 * h)
        np.testing.assert_allclose(getattr(at, rate), difference, atol=1e-8)
    np.testing.assert_allclose(at.J @ at.q_dot, at.X_dot, atol=1e-14)


def test_inertia_rate_less_twice_coriolis_is_skew(
    redundant: Any, random_motion: Callable[..., Any]
) -> None:
    motion, h = random_motion(2, redundant.joints), 1e-6
    before, after = redundant.terms(*motion(0.7 - h)), redundant.terms(*motion(0.7 + h))
    skew = (after.M - before.M) / (2 * h) - 2 * redundant.terms(*motion(0.7)).C
    np.testing.assert_allclose(skew, -skew.T, atol=1e-8)
