"""What every sub-task must satisfy."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

FloatArray = npt.NDArray[np.float64]


@pytest.fixture
def check_gradient(gradient: Callable[..., Any]) -> Callable[..., FloatArray]:
    """g is the negative gradient of f(terms)."""

    def check(
        task: Any, chain: Any, q: FloatArray, f: Callable[..., float], tolerance: float = 1e-6
    ) -> FloatArray:
        still = np.zeros(chain.joints)
        g, _ = task.evaluate(chain.terms(q, still))
        expected = -gradient(lambda q: f(chain.terms(q, still)), q)
        np.testing.assert_allclose(g, expected, rtol=tolerance, atol=tolerance)
        return g

    return check


@pytest.fixture
def check_rate() -> Callable[..., tuple[FloatArray, FloatArray]]:
    """ġ is the derivative of g along a motion."""

    def check(
        task: Any, chain: Any, motion: Any, t: float, tolerance: float = 1e-6, h: float = 1e-6
    ) -> tuple[FloatArray, FloatArray]:
        g, g_dot = task.evaluate(chain.terms(*motion(t)))
        before, _ = task.evaluate(chain.terms(*motion(t - h)))
        after, _ = task.evaluate(chain.terms(*motion(t + h)))
        scale = 1.0 + np.abs(g_dot).max()
        np.testing.assert_allclose(
            g_dot, (after - before) / (2 * h), rtol=tolerance, atol=tolerance * scale
        )
        return g, g_dot

    return check
