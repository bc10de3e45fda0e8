from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from control_law.sub_tasks.obstacle import SegmentAvoidance

FloatArray = npt.NDArray[np.float64]


R, GAIN = 0.2, 3.0
CORE = 0.01 * R


def nearest_distance(start: FloatArray, end: FloatArray, center: FloatArray) -> float:
    """Find the distance to a segment by ternary search."""

    def distance(along: float) -> float:
        return float(np.linalg.norm(start + along * (end - start) - center))

    low, high = 0.0, 1.0
    for _ in range(50):
        third = (high - low) / 3
        if distance(low + third) < distance(high - third):
            high -= third
        else:
            low += third
    return distance(0.5 * (low + high))


def potential(center: FloatArray) -> Callable[[Any], float]:
    """Σ (κ/3)(R − d)₊³, d rounded off within the core."""

    def f(terms: Any) -> float:
        total = 0.0
        for start, end in zip(terms.origins[:-1], terms.origins[1:], strict=True):
            distance = np.hypot(nearest_distance(start, end, center), CORE)
            total += GAIN / 3 * max(0.0, R - distance) ** 3
        return total

    return f


def near(chain: Any, q: FloatArray, link: int, along: float, offset: FloatArray) -> FloatArray:
    origins = chain.terms(q, np.zeros(chain.joints)).origins
    return origins[link] + along * (origins[link + 1] - origins[link]) + offset


@pytest.mark.parametrize("along", [-0.2, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_is_the_gradient(
    redundant: Any,
    random_motion: Callable[..., Any],
    check_gradient: Callable[..., Any],
    seed: int,
    along: float,
) -> None:
    q, _ = random_motion(seed, redundant.joints)(0.0)
    center = near(redundant, q, 1, along, np.array([0.05, -0.07, 0.0]))
    g = check_gradient(SegmentAvoidance(center, R, GAIN), redundant, q, potential(center), 1e-5)
    assert np.linalg.norm(g) > 1e-4


@pytest.mark.parametrize("along", [-0.2, 0.5, 1.1])
@pytest.mark.parametrize("seed", range(5))
def test_rate_counts_the_sliding_contact_point(
    redundant: Any,
    random_motion: Callable[..., Any],
    check_rate: Callable[..., Any],
    seed: int,
    along: float,
) -> None:
    motion = random_motion(seed, redundant.joints)
    center = near(redundant, motion(0.5)[0], 1, along, np.array([0.05, -0.07, 0.0]))
    g, _ = check_rate(SegmentAvoidance(center, R, GAIN), redundant, motion, 0.5, 1e-5)
    assert np.linalg.norm(g) > 1e-4


@pytest.mark.parametrize("distance", [0.5, 0.21, 0.199, 0.1, 0.05, 1e-2, 1e-5, 1e-12, 0.0])
def test_pushes_outwards_at_every_depth_and_never_hard(
    planar_chain: Callable[..., Any], distance: float
) -> None:
    chain = planar_chain(1, 1.0)
    task = SegmentAvoidance(np.array([0.5, -distance]), R, GAIN)
    g, g_dot = task.evaluate(chain.terms(np.zeros(1), np.ones(1)))
    assert 0.0 <= g[0] <= 0.5 * GAIN * R**2
    assert (g[0] > 0) == (0 < distance < R)
    assert abs(g_dot[0]) <= GAIN * R**2 / CORE
    if 0.1 * distance > CORE:
        np.testing.assert_allclose(g, 0.5 * GAIN * max(0.0, R - distance) ** 2, rtol=0.05)


def test_is_smooth_where_it_starts_to_act(planar_chain: Callable[..., Any]) -> None:
    chain, task = planar_chain(1, 1.0), SegmentAvoidance(np.array([0.5, -R + 1e-4]), R, GAIN)
    g, g_dot = task.evaluate(chain.terms(np.zeros(1), np.ones(1)))
    assert abs(g[0]) < 1e-6
    assert abs(g_dot[0]) < 1e-3


def test_a_link_without_length_is_a_point(planar_chain: Callable[..., Any]) -> None:
    chain = planar_chain(2, 0.5)
    terms = chain.terms(np.array([0.2, 0.4]), np.ones(2))
    squeezed = terms.origins.copy()
    squeezed[1] = squeezed[0]
    object.__setattr__(terms, "origins", squeezed)
    g, g_dot = SegmentAvoidance(np.array([0.1, 0.1]), R, GAIN).evaluate(terms)
    assert np.isfinite(g).all()
    assert np.isfinite(g_dot).all()


def test_refuses_what_makes_no_sense() -> None:
    with pytest.raises(ValueError, match="activation distance"):
        SegmentAvoidance(np.zeros(2), 0.0, 1.0)
    with pytest.raises(ValueError, match="gain"):
        SegmentAvoidance(np.zeros(2), 0.1, -1.0)
    with pytest.raises(ValueError, match="coordinates"):
        SegmentAvoidance(np.zeros(4), 0.1, 1.0)
