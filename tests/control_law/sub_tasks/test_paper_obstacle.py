from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from control_law.sub_tasks.paper_obstacle import StipanovicAvoidance

FloatArray = npt.NDArray[np.float64]


SAFE, COLLISION, GAIN = 0.2, 0.1, 0.3


def potential(center: FloatArray) -> Callable[[Any], float]:
    def f(terms: Any) -> float:
        total = 0.0
        for i in range(len(terms.q)):
            offset = 0.5 * (terms.origins[i] + terms.origins[i + 1]) - center
            distance2 = offset @ offset
            total += min(0.0, (distance2 - SAFE**2) / (distance2 - COLLISION**2)) ** 2
        return GAIN * total

    return f


def near_midpoint(chain: Any, q: FloatArray, link: int, offset: FloatArray) -> FloatArray:
    """An obstacle at an offset from a link's midpoint."""
    origins = chain.terms(q, np.zeros(chain.joints)).origins
    return 0.5 * (origins[link] + origins[link + 1]) + offset


@pytest.mark.parametrize("link", range(3))
@pytest.mark.parametrize("seed", range(3))
def test_is_the_gradient(
    redundant: Any,
    random_motion: Callable[..., Any],
    check_gradient: Callable[..., Any],
    seed: int,
    link: int,
) -> None:
    q, _ = random_motion(seed, redundant.joints)(0.0)
    center = near_midpoint(redundant, q, link, np.array([0.12, -0.09, 0.0]))
    task = StipanovicAvoidance(center, SAFE, COLLISION, GAIN)
    g = check_gradient(task, redundant, q, potential(center))
    assert np.linalg.norm(g) > 1e-3


@pytest.mark.parametrize("link", range(3))
@pytest.mark.parametrize("seed", range(3))
def test_rate(
    redundant: Any,
    random_motion: Callable[..., Any],
    check_rate: Callable[..., Any],
    seed: int,
    link: int,
) -> None:
    motion = random_motion(seed, redundant.joints)
    center = near_midpoint(redundant, motion(0.5)[0], link, np.array([0.12, -0.09, 0.0]))
    check_rate(StipanovicAvoidance(center, SAFE, COLLISION, GAIN), redundant, motion, 0.5)


@pytest.mark.parametrize(
    ("distance", "pull"),
    [(0.19, 5.0), (0.15, 161.0), (0.21, 0.0), (0.2, 0.0), (0.1, 0.0), (0.05, 0.0), (0.0, 0.0)],
)
def test_pull_at_known_distances(
    planar_chain: Callable[..., Any], distance: float, pull: float
) -> None:
    """One link turning about the origin, its midpoint pushed square to it."""
    chain, q = planar_chain(1, 1.0), np.zeros(1)
    task = StipanovicAvoidance(np.array([0.5, -distance]), SAFE, COLLISION, 1.0)
    g, g_dot = task.evaluate(chain.terms(q, np.ones(1)))
    np.testing.assert_allclose(g, 0.5 * pull, rtol=0.05)
    assert np.isfinite(g_dot).all()


@pytest.mark.parametrize(("safe", "collision"), [(0.1, 0.2), (0.1, 0.1), (0.1, 0.0)])
def test_refuses_radii_out_of_order(safe: float, collision: float) -> None:
    with pytest.raises(ValueError, match="collision radius"):
        StipanovicAvoidance(np.zeros(2), safe, collision, 1.0)
