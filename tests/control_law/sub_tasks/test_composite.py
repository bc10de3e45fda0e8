from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from control_law.ramp import smooth_ramp
from control_law.sub_tasks.composite import NormLimiter, WeightedSum, ramped
from control_law.sub_tasks.joint_limits import JointCentring
from control_law.sub_tasks.linear import LinearSingularityAvoidance
from control_law.sub_tasks.manipulability import ManipulabilityAscent

FloatArray = npt.NDArray[np.float64]


LINEAR = LinearSingularityAvoidance(0.5, np.array([1.0, -2.0, 1.0]))
CLIMB = ManipulabilityAscent(20.0)
CENTRE = JointCentring(np.full(3, -2.0), np.full(3, 3.0), 1.0)


def test_sum_adds_what_its_parts_want(
    planar_chain: Callable[..., Any],
    random_motion: Callable[..., Any],
    check_rate: Callable[..., Any],
) -> None:
    motion = random_motion(1, 3)
    terms = planar_chain(3).terms(*motion(0.5))
    g, g_dot = check_rate(
        WeightedSum((LINEAR, CLIMB, CENTRE), (2.0, 0.5, 0.0)), planar_chain(3), motion, 0.5
    )
    a, a_dot = LINEAR.evaluate(terms)
    b, b_dot = CLIMB.evaluate(terms)
    np.testing.assert_allclose(g, 2 * a + 0.5 * b)
    np.testing.assert_allclose(g_dot, 2 * a_dot + 0.5 * b_dot)


@pytest.mark.parametrize("ceiling", [0.05, 1.0, 50.0])
def test_limiter_keeps_the_direction_and_the_ceiling(
    planar_chain: Callable[..., Any],
    random_motion: Callable[..., Any],
    check_rate: Callable[..., Any],
    ceiling: float,
) -> None:
    motion = random_motion(2, 3)
    wanted, _ = LINEAR.evaluate(planar_chain(3).terms(*motion(0.5)))
    g, _ = check_rate(NormLimiter(LINEAR, ceiling), planar_chain(3), motion, 0.5)
    size = np.linalg.norm(wanted)
    assert np.linalg.norm(g) < min(ceiling, size)
    np.testing.assert_allclose(g, wanted / np.sqrt(1 + (size / ceiling) ** 2))


def test_ramp_fades_in_with_its_own_rate(
    planar_chain: Callable[..., Any], random_motion: Callable[..., Any]
) -> None:
    motion, chain, h = random_motion(3, 3), planar_chain(3), 1e-6

    def faded(t: float) -> FloatArray:
        return ramped(CLIMB.evaluate(chain.terms(*motion(t))), smooth_ramp(t, 0.5))

    assert not faded(0.0)[0].any()
    difference = (faded(0.2 + h)[0] - faded(0.2 - h)[0]) / (2 * h)
    np.testing.assert_allclose(faded(0.2)[1], difference, rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(faded(0.6)[0], CLIMB.evaluate(chain.terms(*motion(0.6)))[0])


def test_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="weights"):
        WeightedSum((LINEAR,), (1.0, 2.0))
    with pytest.raises(ValueError, match="weights"):
        WeightedSum((LINEAR,), (-1.0,))
    with pytest.raises(ValueError, match="at least one"):
        WeightedSum((), ())
    with pytest.raises(ValueError, match="ceiling"):
        NormLimiter(LINEAR, 0.0)
