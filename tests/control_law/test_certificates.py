"""Each theorem at its edge: the bound holds where it claims, and the printed numbers come out."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from control_law.certificates import (
    SiteGains,
    best,
    paper_condition,
    relaxation_theorem_a,
    relaxation_theorem_b,
    required_joint_damping_paper,
    required_joint_damping_theorem_a,
    required_relaxation,
    required_scale,
    required_task_damping_theorem_b,
    round_trip,
    theorem_a,
    theorem_b,
)
from control_law.coupling import Coupling
from control_law.damping import Damping

FloatArray = npt.NDArray[np.float64]


REACH_L, REACH_R = 0.38 * np.array([2.0, 1.0]), 0.38 * np.array([3.0, 2.0, 1.0])
PAPER = Coupling.paper(np.ones(2), np.ones(2))
STIFF = Coupling.from_stiffness(np.array([50.0, 80.0]), np.full(2, 5.0))


def gains(
    joint: list[float] | FloatArray,
    reach_m: FloatArray,
    task: tuple[float, ...] | FloatArray = (0.0, 0.0),
) -> SiteGains:
    return SiteGains(Damping(np.array(joint), np.array(task)), reach_m)


LOCAL = gains([0.94, 0.94], REACH_L)
REMOTE = gains([3.19, 3.20, 3.21], REACH_R)


def test_the_papers_own_numbers() -> None:
    assert required_joint_damping_paper(0.4, PAPER, REACH_L) == pytest.approx(0.924, abs=5e-4)
    assert required_joint_damping_paper(0.4, PAPER, REACH_R) == pytest.approx(3.119, abs=5e-4)
    certificate = paper_condition(PAPER, LOCAL, REMOTE)
    assert 0.4 < certificate.round_trip_s < 0.41
    assert "local" in certificate.reason


def test_paper_condition_at_its_edge() -> None:
    local = gains([required_joint_damping_paper(0.4, PAPER, REACH_L)] * 2, REACH_L)
    remote = gains([required_joint_damping_paper(0.4, PAPER, REACH_R)] * 3, REACH_R)
    assert paper_condition(PAPER, local, remote).round_trip_s == pytest.approx(0.4, rel=1e-12)
    weaker = gains([local.damping.joint[0], 0.99 * local.damping.joint[1]], REACH_L)
    assert paper_condition(PAPER, weaker, remote).round_trip_s == pytest.approx(0.396)


def test_theorem_a_numbers() -> None:
    assert required_joint_damping_theorem_a(0.4, PAPER, REACH_L) == pytest.approx(0.144, abs=5e-4)
    assert required_joint_damping_theorem_a(0.4, PAPER, REACH_R) == pytest.approx(0.404, abs=5e-4)
    assert theorem_a(PAPER, LOCAL, REMOTE).round_trip_s == pytest.approx(2.87, abs=5e-3)


def test_theorem_a_lets_one_site_pay_for_the_other() -> None:
    local = gains([0.94 / 4] * 2, REACH_L)
    remote = gains([3.19 * 4, 3.20 * 4, 3.21 * 4], REACH_R)
    assert theorem_a(PAPER, local, remote).round_trip_s == pytest.approx(
        theorem_a(PAPER, LOCAL, REMOTE).round_trip_s
    )
    assert paper_condition(PAPER, local, remote).round_trip_s < 0.11


def margin(chain: Any, joint: FloatArray, q: FloatArray, weight: float) -> float:
    """λ_min(Λ − c JᵀKJ) for the paper's K = I."""
    J = chain.terms(q, np.zeros(chain.joints)).J
    return np.linalg.eigvalsh(np.diag(joint) - weight * J.T @ J)[0]


def test_theorem_a_is_exact_for_a_planar_arm(planar_chain: Callable[..., Any]) -> None:
    """At T the worst pose, the straight one, has no margin left; a little below, all have some."""
    trip = theorem_a(PAPER, LOCAL, REMOTE).round_trip_s
    arms = ((planar_chain(2), LOCAL.damping.joint), (planar_chain(3), REMOTE.damping.joint))
    sup = [
        1 / np.linalg.eigvalsh(
            (J := chain.terms(np.zeros(chain.joints), np.zeros(chain.joints)).J)
            @ np.diag(1 / joint) @ J.T
        )[-1]
        for chain, joint in arms
    ]  # fmt: skip
    alpha = np.sqrt(sup[0] / sup[1])  # the α = 1/γ the theorem chooses: c_l μ_l = c_r μ_r
    weights = (0.5 * trip * alpha, 0.5 * trip / alpha)
    rng = np.random.default_rng(0)
    for (chain, joint), weight in zip(arms, weights, strict=True):
        assert margin(chain, joint, np.zeros(chain.joints), weight) == pytest.approx(0, abs=1e-9)
        assert margin(chain, joint, np.zeros(chain.joints), 1.01 * weight) < 0
        for q in rng.uniform(-np.pi, np.pi, (200, chain.joints)):
            assert margin(chain, joint, q, 0.999 * weight) > 0


def test_the_stiffest_axis_decides_and_only_the_paper_ignores_the_slope() -> None:
    even = Coupling.paper(np.full(2, 2.0), np.ones(2))
    uneven = Coupling.paper(np.array([1.0, 2.0]), np.ones(2))
    softened = Coupling.paper(np.array([1.0, 2.0]), np.full(2, 0.5))
    for rule in (paper_condition, theorem_a):
        assert rule(uneven, LOCAL, REMOTE) == rule(even, LOCAL, REMOTE)
    assert paper_condition(softened, LOCAL, REMOTE) == paper_condition(uneven, LOCAL, REMOTE)
    assert theorem_a(softened, LOCAL, REMOTE).round_trip_s == pytest.approx(
        2 * theorem_a(uneven, LOCAL, REMOTE).round_trip_s
    )


def test_theorem_b_at_its_edge() -> None:
    task = required_task_damping_theorem_b(0.4, STIFF)
    np.testing.assert_allclose(task, [10.0, 16.0])
    local, remote = gains([0.05] * 2, REACH_L, task), gains([0.05] * 3, REACH_R, task)
    assert theorem_b(STIFF, local, remote).round_trip_s == pytest.approx(0.4, rel=1e-12)
    weaker = gains([0.05] * 3, REACH_R, task * [1.0, 0.81])
    certificate = theorem_b(STIFF, local, weaker)
    assert certificate.round_trip_s == pytest.approx(0.36)
    assert "axis 1" in certificate.reason


def test_theorem_b_lets_one_site_pay_for_the_other() -> None:
    task = required_task_damping_theorem_b(0.4, STIFF)
    local, remote = gains([0.05] * 2, REACH_L, task / 3), gains([0.05] * 3, REACH_R, task * 3)
    assert theorem_b(STIFF, local, remote).round_trip_s == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("rule", "site"),
    [
        (paper_condition, lambda T, h, reach: gains(
            [required_joint_damping_paper(T, STIFF, reach, h)] * len(reach), reach)),
        (theorem_a, lambda T, h, reach: gains(
            [required_joint_damping_theorem_a(T, STIFF, reach, h)] * len(reach), reach)),
        (theorem_b, lambda T, h, reach: gains(
            [0.05] * len(reach), reach, required_task_damping_theorem_b(T, STIFF, h))),
    ],
)  # fmt: skip
def test_a_hold_costs_twice_itself_when_both_sites_are_alike(rule: Any, site: Any) -> None:
    local, remote = site(0.4, 0.003, REACH_L), site(0.4, 0.003, REACH_R)
    assert rule(STIFF, local, remote).round_trip_s == pytest.approx(0.406)
    assert rule(STIFF, local, remote, 0.003).round_trip_s == pytest.approx(0.4)
    assert rule(STIFF, local, remote, 0.25).round_trip_s == 0.0
    assert "hold" in rule(STIFF, local, remote, 0.25).reason


def test_a_hold_costs_more_when_one_site_pays_for_the_other() -> None:
    task = required_task_damping_theorem_b(0.4, STIFF)
    local, remote = gains([0.05] * 2, REACH_L, task / 4), gains([0.05] * 3, REACH_R, task * 4)
    # (D_l/K − h)(D_r/K − h) = (T/2)²
    expected = 2 * np.sqrt((0.05 - 0.01) * (0.8 - 0.01))
    assert theorem_b(STIFF, local, remote, 0.01).round_trip_s == pytest.approx(expected)
    assert expected < 0.4 - 2 * 0.01


def test_the_best_is_the_longest() -> None:
    assert best(PAPER, LOCAL, REMOTE) == theorem_a(PAPER, LOCAL, REMOTE)
    task = required_task_damping_theorem_b(5.0, PAPER)
    local, remote = gains([0.94] * 2, REACH_L, task), gains([3.19] * 3, REACH_R, task)
    assert best(PAPER, local, remote).theorem == "Theorem B"
    assert best(PAPER, local, remote).round_trip_s == pytest.approx(5.0)


def test_without_task_damping_theorem_b_certifies_nothing_and_says_so() -> None:
    certificate = theorem_b(PAPER, LOCAL, REMOTE)
    assert certificate.round_trip_s == 0.0
    assert "no task damping along axis 0 at the local and the remote site" in certificate.reason
    held = theorem_b(PAPER, LOCAL, gains([3.19] * 3, REACH_R, (0.5, 0.0)), 0.001)
    assert "no task damping along axis 0 at the local site" in held.reason


def test_damping_that_the_hold_uses_up_is_named() -> None:
    weak = gains([1e-3] * 3, REACH_R, (1.0, 1e-4))
    damped = gains([0.94] * 2, REACH_L, (1.0, 1.0))
    reasons = [rule(PAPER, damped, weak, 0.01).reason for rule in (paper_condition, theorem_a)]
    reasons.append(theorem_b(PAPER, damped, weak, 0.01).reason)
    assert all("hold of 10 ms" in reason and "remote" in reason for reason in reasons)
    assert "axis 1" in reasons[-1]


RELAXATIONS = np.random.default_rng(3).uniform(0.02, 2.0, (2, 50))


@pytest.mark.parametrize("hold_s", [0.0, 0.01])
def test_the_scale_brings_both_sites_to_the_edge(hold_s: float) -> None:
    local, remote = RELAXATIONS
    scale = required_scale(local, remote, 0.4, hold_s)
    np.testing.assert_allclose(round_trip(scale * local, scale * remote, hold_s), 0.4)
    # The other root leaves neither site anything beside the hold.
    assert (scale * np.minimum(local, remote) > hold_s).all()


@pytest.mark.parametrize("hold_s", [0.0, 0.01])
def test_what_one_site_needs_beside_the_other_is_the_edge(hold_s: float) -> None:
    needed = required_relaxation(RELAXATIONS[0], 0.4, hold_s)
    np.testing.assert_allclose(round_trip(needed, RELAXATIONS[0], hold_s), 0.4)


@pytest.mark.parametrize("hold_s", [0.0, 0.01])
def test_from_nothing_no_scale_and_beside_nothing_no_damping_is_enough(hold_s: float) -> None:
    nothing, some = np.zeros(2), np.array([0.0, 1.0])
    np.testing.assert_array_equal(required_scale(nothing, some, 0.4, hold_s), [np.inf, np.inf])
    np.testing.assert_array_equal(required_relaxation(nothing, 0.4, hold_s), [np.inf, np.inf])


def test_the_relaxations_are_in_proportion_to_damping_over_stiffness() -> None:
    site = gains([0.5, 0.7], REACH_L, (5.0, 16.0))
    np.testing.assert_allclose(relaxation_theorem_b(STIFF, site), [0.1, 0.2])
    expected = 1 / (80 * (0.76**2 / 0.5 + 0.38**2 / 0.7))
    np.testing.assert_allclose(relaxation_theorem_a(STIFF, site), [expected])


@pytest.mark.parametrize("reach", [[0.76], [0.76, 0.0], [0.76, np.inf]])
def test_refuses_a_reach_that_is_none(reach: list[float]) -> None:
    with pytest.raises(ValueError, match="reach"):
        gains([1.0, 1.0], np.array(reach))
