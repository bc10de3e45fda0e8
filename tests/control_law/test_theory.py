"""What docs/theory.md states and a few lines can check; the rest is tested where it is coded."""

from collections.abc import Callable
from dataclasses import dataclass
from math import atan, ceil, pi, sin, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from control_law.certificates import SiteGains, paper_condition, theorem_a, theorem_b
from control_law.control import control_torque
from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.null_space import manipulability, null_space_velocity
from control_law.sampling import (
    LIMIT_IMMEDIATE,
    LIMIT_LATE_DIFFERENCE,
    LIMIT_LATE_EXACT,
    damping_ratio,
)
from control_law.saturation import Arctangent

FloatArray = npt.NDArray[np.float64]


def weights(
    alpha: float, gamma: float, delay_l: float, delay_r: float
) -> tuple[float | FloatArray, float | FloatArray]:
    """c_l, c_r of Lemma 4."""
    return 0.5 * (alpha * delay_r + delay_l / gamma), 0.5 * (gamma * delay_l + delay_r / alpha)


# Lemma 1: the age of the newest-stamped packet that has arrived, just before the next tick.


@pytest.mark.parametrize("losses", [0, 1, 3])
@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_no_sample_in_use_is_older_than_lemma_1_says(losses: int, jitter: float) -> None:
    spacing_s, transit_s, tick_s = 0.01, 0.05, 0.0041
    rng = np.random.default_rng(0)

    def shortened(longest: float, count: int) -> FloatArray:
        return longest * (1.0 - jitter * rng.uniform(0.0, 1.0, count))

    stamps = shortened(spacing_s, 20_000).cumsum()
    arrivals = stamps + shortened(transit_s, len(stamps))
    # every run of losses as long as allowed
    delivered = np.arange(len(stamps)) % (losses + 1) == 0
    ticks = (1.0 + shortened(tick_s, 9000).cumsum()).clip(max=stamps[-1])
    order = np.argsort(arrivals[delivered])
    newest = np.maximum.accumulate(stamps[delivered][order])
    used = newest[np.searchsorted(arrivals[delivered][order], ticks[:-1], "right") - 1]
    oldest = (ticks[1:] - used).max()
    bound = transit_s + (1 + losses) * spacing_s + tick_s
    assert oldest <= bound
    if jitter == 0.0:
        assert oldest > bound - 0.05 * tick_s


# Section 2: the gap at (14), at a constant speed v over the delay d, e_l = vd/2 = −e_l⁰.


def difference(v: float, d: float) -> float:
    p = Arctangent.paper(np.ones(1))
    return float(p(np.array([0.5 * v * d]))[0] - p(np.array([-0.5 * v * d]))[0])


def bound_of_14(v: float, d: float) -> float:
    return 2.0 * d * float(Arctangent.paper(np.ones(1))(np.array([v]))[0])


def test_the_printed_lemma_fails_at_ten_metres_a_second() -> None:
    assert difference(10.0, 0.2) == pytest.approx(pi / 2)
    assert bound_of_14(10.0, 0.2) == pytest.approx(0.4 * atan(10.0))
    assert difference(2.394, 0.2) < bound_of_14(2.394, 0.2)
    assert difference(2.396, 0.2) > bound_of_14(2.396, 0.2)


@given(
    st.floats(1e-3, 10.0),
    st.floats(1e-3, 1.0),
    st.floats(-5.0, 5.0),
    st.floats(1e-3, 2.0),
    arrays(np.float64, 20, elements=st.floats(-50.0, 50.0)),
)
def test_the_mended_lemma_holds_for_any_motion(
    width: float, slope: float, error: float, delay: float, speeds: FloatArray
) -> None:
    p = Arctangent(np.array([width * slope]), np.array([width]))
    piece = delay / len(speeds)
    late = np.array([error + piece * speeds.sum()])
    change = abs(p(late) - p(np.array([error])))[0]
    assert change <= p.slope[0] * piece * np.abs(speeds).sum() * (1 + 1e-12) + 1e-14


# Section 3: Theorem A.


@given(st.floats(0.0, 1.0), st.floats(0.05, 20.0), st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_weights_exist_below_the_round_trip_of_theorem_a_and_none_above(
    split: float, damping_r: float, log_alpha: float, log_gamma: float
) -> None:
    coupling = Coupling.paper(np.array([2.0, 1.0]), np.array([0.5, 0.8]))
    lengths = (np.array([0.4, 0.3]), np.array([0.38, 0.2, 0.1]))
    joints = (np.array([0.7, 0.2]), damping_r * np.array([1.0, 2.0, 0.5]))
    reach = [length[::-1].cumsum()[::-1] for length in lengths]
    # μ by its definition, at the straight pose; the stiffer axis is across the arm
    mu = []
    for joint, columns in zip(joints, reach, strict=True):
        J = np.vstack([columns, np.zeros_like(columns)])
        root = np.diag(1.0 / np.sqrt(joint))
        mu.append(np.linalg.eigvalsh(root @ (J.T * coupling.stiffness) @ J @ root)[-1])
    sites = [
        SiteGains(Damping(joint, np.zeros(2)), columns)
        for joint, columns in zip(joints, reach, strict=True)
    ]
    trip = theorem_a(coupling, *sites).round_trip_s
    below, above = 0.999 * trip, 1.001 * trip
    alpha = sqrt(mu[1] / mu[0])
    c_l, c_r = weights(alpha, 1.0 / alpha, split * below, (1.0 - split) * below)
    assert c_l * mu[0] < 1.0
    assert c_r * mu[1] < 1.0
    for a, g in ((np.exp(log_alpha), np.exp(log_gamma)), (alpha, 1.0 / alpha)):
        c_l, c_r = weights(a, g, split * above, (1.0 - split) * above)
        assert max(c_l * mu[0], c_r * mu[1]) > 1.0


@given(st.data())
def test_the_papers_condition_implies_theorem_a_four_times_over(data: st.DataObject) -> None:
    sites = [
        SiteGains(Damping(data.draw(positive(n)), np.zeros(2)), data.draw(positive(n)))
        for n in data.draw(st.tuples(st.integers(1, 7), st.integers(1, 7)))
    ]
    slope = data.draw(arrays(np.float64, 2, elements=st.floats(0.01, 1.0)))
    coupling = Coupling.paper(data.draw(positive(2)), slope)
    hold_s = data.draw(st.sampled_from([0.0, 1e-6, 1e-3]))  # Section 8.1: with a hold too
    printed = paper_condition(coupling, *sites, hold_s).round_trip_s
    assert theorem_a(coupling, *sites, hold_s).round_trip_s >= 4.0 * printed * (1 - 1e-12)


def positive(n: int) -> st.SearchStrategy[FloatArray]:
    return arrays(np.float64, n, elements=st.floats(1e-2, 1e2))


def test_four_is_attained_by_one_joint_at_each_site() -> None:
    site = SiteGains(Damping(np.array([0.5]), np.zeros(2)), np.array([0.4]))
    coupling = Coupling.paper(np.ones(2), np.ones(2))
    printed = paper_condition(coupling, site, site).round_trip_s
    assert theorem_a(coupling, site, site).round_trip_s == pytest.approx(4.0 * printed)


# Section 4: Theorem B wants weights per axis.


def test_one_pair_of_weights_may_fail_where_theorem_b_certifies() -> None:
    K, reach = np.ones(2), np.array([1.0])
    coupling = Coupling.from_stiffness(K, np.full(2, 5.0))
    D_l, D_r = np.array([0.5, 100.0]), np.array([100.0, 1.0])
    sites = [SiteGains(Damping(np.ones(1), D), reach) for D in (D_l, D_r)]
    assert theorem_b(coupling, *sites).round_trip_s > 7.0
    trip = 2.0
    alpha, gamma = np.meshgrid(np.geomspace(1e-3, 1e3, 601), np.geomspace(1e-3, 1e3, 601))
    c_l, c_r = weights(alpha, gamma, 0.5 * trip, 0.5 * trip)
    assert not ((c_l <= D_l.min()) & (c_r <= D_r.min())).any()
    per_axis = np.sqrt(D_l / D_r)
    c_l, c_r = weights(per_axis, 1.0 / per_axis, 0.5 * trip, 0.5 * trip)
    assert (c_l * K <= D_l).all()
    assert (c_r * K <= D_r).all()


# Section 6: what the adjugate keeps and a damped pseudo-inverse breaks.


@pytest.mark.parametrize("bend_rad", [0.0, 1e-6, 1e-3, 0.03, 0.3])
def test_a_damped_pseudo_inverse_moves_the_end_effector_and_the_adjugate_does_not(
    planar_chain: Callable[..., Any], bend_rad: float
) -> None:
    J = planar_chain(3).terms(np.array([0.4, bend_rad, -0.5 * bend_rad]), np.zeros(3)).J
    g, regularisation, damping = np.array([0.3, -1.0, 0.7]), 1e-4, 0.05
    damped = g - J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(2), J @ g)
    moved = damping**2 * np.linalg.solve(J @ J.T + damping**2 * np.eye(2), J @ g)
    np.testing.assert_allclose(J @ damped, moved, rtol=1e-6, atol=1e-15)
    assert 1e-5 < np.linalg.norm(J @ damped) <= 0.5 * damping * np.linalg.norm(g)
    zeta, _ = null_space_velocity(J, np.zeros_like(J), g, np.zeros(3), regularisation)
    assert np.linalg.norm(J @ zeta) <= 1e-12
    w, own = manipulability(J), np.linalg.svd(J)[2][-1]
    assert np.linalg.norm(zeta) <= w / (w + regularisation) * np.linalg.norm(g) + 1e-12
    zeta, _ = null_space_velocity(J, np.zeros_like(J), own, np.zeros(3), regularisation)
    np.testing.assert_allclose(zeta, w / (w + regularisation) * own, rtol=1e-6, atol=1e-12)


def test_at_a_damping_of_a_singular_value_the_damped_inverse_is_at_its_worst() -> None:
    J, damping = np.array([[0.05, 0.0, 0.0], [0.0, 1.0, 0.0]]), 0.05
    N = np.eye(3) - J.T @ np.linalg.inv(J @ J.T + damping**2 * np.eye(2)) @ J
    assert np.linalg.norm(J @ N, 2) == pytest.approx(0.5 * damping)


# Section 8.2: lateness, and a filter on the velocity, lower the limit of a sampled damper.


@pytest.mark.parametrize(
    ("late", "limit"), [(0, LIMIT_IMMEDIATE), (1, LIMIT_LATE_EXACT), (2, 0.618034), (3, 0.445042)]
)
def test_the_limit_of_an_exact_damper_some_periods_late(late: int, limit: float) -> None:
    assert limit == pytest.approx(2.0 * sin(pi / (4 * late + 2)), rel=1e-6)

    def radius(a: float) -> float:
        characteristic = np.zeros(late + 2)  # z^(n+1) − z^n + a
        characteristic[:2] = 1.0, -1.0
        characteristic[-1] += a
        return float(np.abs(np.roots(characteristic)).max())

    assert radius(0.998 * limit) < 1.0 < radius(1.002 * limit)


@pytest.mark.parametrize(
    ("share", "late", "limit"),
    [
        (1.0, True, LIMIT_LATE_DIFFERENCE),
        (1.0 / 4.8, True, 0.6982),  # 3.8 ms at 1 kHz
        (1e-3, True, 2.0 / 3.0),
        (1.0 / 4.8, False, LIMIT_IMMEDIATE),
    ],
)
def test_the_limit_of_a_filtered_damper(share: float, late: bool, limit: float) -> None:
    assert spectral_radius(0.998 * limit, share, late) < 1.0
    assert spectral_radius(1.002 * limit, share, late) > 1.0


@given(*[st.floats(-3.0, 3.0)] * 4)
def test_a_filtered_damper_on_a_spring_is_stable_however_slow_the_filter(
    log_mass: float, log_damping: float, log_stiffness: float, log_filter: float
) -> None:
    mass, damping, stiffness, filter_s = 10.0 ** np.array(
        [log_mass, log_damping, log_stiffness, log_filter]
    )
    dynamics = [
        [0.0, 1.0, 0.0],
        [-stiffness / mass, 0.0, -damping / mass],
        [0.0, 1.0 / filter_s, -1.0 / filter_s],
    ]
    printed = [mass * filter_s, mass, damping + stiffness * filter_s, stiffness]
    np.testing.assert_allclose(np.poly(dynamics), np.divide(printed, printed[0]), rtol=1e-6)
    cubic, square, linear, constant = printed
    assert square * linear > cubic * constant  # Routh


def spectral_radius(a: float, share: float, late: bool) -> float:
    """Of one period of unit mass: state velocity, velocity before, filtered, force pending."""

    def step(state: FloatArray) -> FloatArray:
        v, v_before, filtered, pending = state
        filtered = filtered + share * (0.5 * (v + v_before) - filtered)
        force, pending = (pending, -a * filtered) if late else (-a * filtered, 0.0)
        return np.array([v + force, v, filtered, pending])

    matrix = np.array([step(unit) for unit in np.eye(4)]).T
    return float(np.abs(np.linalg.eigvals(matrix)).max())


# Section 8.3: energy in one tick, and the sampled loop.


@dataclass(frozen=True)
class Tick:
    """One semi-implicit tick of an arm by (6) with ζ = 0, and what Lemma 7 says of it."""

    rise: float
    lemma_7: float
    proposition_4: float
    R_X: float
    R_M: float
    R_M_expanded: float
    R_K: float
    kappa_bound: float
    displacement: FloatArray


TRIP_COST_S = 0.2  # c + h of R_K, with K = 1


def largest_second_derivative(lengths: FloatArray) -> float:
    """κ_X of a planar arm: all links' centripetal terms in line."""
    angles = np.tri(len(lengths))
    return float(np.linalg.eigvalsh((angles.T * lengths) @ angles)[-1])


def test_the_printed_second_derivatives() -> None:
    assert largest_second_derivative(np.full(3, 0.38)) == pytest.approx(1.919, abs=5e-4)
    assert largest_second_derivative(np.full(2, 0.38)) == pytest.approx(0.995, abs=5e-4)


def tick(
    chain: Any, q: FloatArray, v: FloatArray, force: FloatArray, damping: Damping, h: float
) -> Tick:
    terms = chain.terms(q, v)
    torque, _ = control_torque(terms, force, damping, np.zeros_like(q), np.zeros_like(q))
    M, J, Lambda = terms.M, terms.J, damping.matrix(terms.J)
    q_ddot = np.linalg.solve(M, torque - terms.C @ v - terms.G)
    v_next = v + h * q_ddot
    after = chain.terms(q + h * v_next, v_next)
    displacement = after.X - terms.X
    R_X = float((displacement - h * J @ v_next) @ force)
    R_M = float(0.5 * v_next @ (after.M - M) @ v_next - h * v_next @ terms.C @ v)
    eps = 1e-6
    ahead, behind = (chain.terms(q + side * v_next, v).M for side in (eps, -eps))
    second_order = after.M - M - h * (ahead - behind) / (2 * eps)
    kappa = largest_second_derivative(chain.lengths)
    mean_velocity, X_dot = displacement / h, J @ v_next
    shared = -float(displacement @ force) + R_X + R_M
    a = damping_ratio(h, M, Lambda)
    return Tick(
        rise=0.5 * float(v_next @ after.M @ v_next - v @ M @ v),
        lemma_7=shared - float(h * v_next @ Lambda @ v + 0.5 * h * h * q_ddot @ M @ q_ddot),
        proposition_4=shared - h * (1.0 - 0.5 * a) * float(v_next @ Lambda @ v_next),
        R_X=R_X,
        R_M=R_M,
        R_M_expanded=float(
            2 * h**2 * v_next @ chain.terms(q, v_next).C @ q_ddot
            - h**3 * v_next @ chain.terms(q, q_ddot).C @ q_ddot
            + 0.5 * v_next @ second_order @ v_next
        ),
        R_K=h * TRIP_COST_S * float(mean_velocity @ mean_velocity - X_dot @ X_dot),
        kappa_bound=0.5 * h * h * kappa * float(v_next @ v_next) * float(np.linalg.norm(force)),
        displacement=displacement,
    )


@pytest.mark.parametrize("joints", [2, 3])
@pytest.mark.parametrize("seed", range(20))
def test_the_energy_of_one_tick_is_accounted_for(
    planar_chain: Callable[..., Any], joints: int, seed: int
) -> None:
    chain, rng = planar_chain(joints), np.random.default_rng(seed)
    q, v = rng.uniform(-pi, pi, joints), rng.normal(size=joints) * rng.choice([0.1, 1.0, 5.0])
    damping = Damping(rng.uniform(0.02, 0.3, joints), rng.uniform(0.0, 60.0, 2))
    force = rng.normal(size=2) * 5.0
    whole, half = (tick(chain, q, v, force, damping, h) for h in (1e-4, 5e-5))
    assert whole.rise == pytest.approx(whole.lemma_7, rel=1e-9, abs=1e-14)
    assert whole.rise <= whole.proposition_4 + 1e-14
    assert abs(whole.R_X) <= whole.kappa_bound + 1e-18
    assert pytest.approx(whole.R_M_expanded, rel=1e-4, abs=1e-13) == whole.R_M
    for name in ("R_X", "R_M", "R_K"):  # of second order in h
        assert getattr(half, name) == pytest.approx(getattr(whole, name) / 4, rel=0.1, abs=1e-10)


@given(
    arrays(np.float64, 2, elements=st.floats(-2.0, 2.0)),
    arrays(np.float64, 2, elements=st.floats(-2.0, 2.0)),
)
def test_the_couplings_energy_lies_within_its_stiffness(
    error: FloatArray, step: FloatArray
) -> None:
    coupling = Coupling.from_stiffness(np.array([50.0, 20.0]), np.array([5.0, 1.0]))
    rise = coupling.energy(error + step) - coupling.energy(error)
    work = float(step @ coupling.force(error))
    assert -1e-12 <= rise - work <= 0.5 * float(step @ (coupling.stiffness * step)) + 1e-12


PERIOD_S, STIFFNESS, FLOOR = 1e-3, 50.0, 0.05


def sampled_energies(
    ages: tuple[int, int], ratio: float, share: float, lopsided: float, steps: int = 2000
) -> FloatArray:
    """W of Theorem S at every tick of two masses on a line.

    Of the samples young enough, each site gets the one that pulls it on hardest, or any.
    Damping is `share` of the least that the theorem allows; `ratio` is a = h(D + Λ₀)/m.
    """
    h, rng = PERIOD_S, np.random.default_rng(0)
    coupling = Coupling.from_stiffness(np.array([STIFFNESS]), np.array([8.0]))
    half_trip = 0.5 * h * sum(ages)
    alpha = lopsided
    task = share * STIFFNESS * (half_trip * np.array([lopsided, 1.0 / lopsided]) + h)
    damping = task + FLOOR
    mass = h * damping / ratio
    X, v = np.array([0.3, -0.2]), np.zeros(2)
    past: list[FloatArray] = [X]
    moved = np.zeros((2, max(ages) + 1))  # newest last
    energies = []
    for _ in range(steps):
        transit = sum(
            weight * STIFFNESS * sum(np.square(moved[site, -n:]).sum() for n in range(1, age + 1))
            for site, age, weight in ((0, ages[0], 0.5 * alpha), (1, ages[1], 0.5 / alpha))
        )
        stored = 0.5 * float((mass - 0.5 * h * damping) @ np.square(v))
        energies.append(stored + coupling.energy(X[:1] - X[1:]) + transit)
        seen = np.empty(2)
        for site, age in enumerate(ages):
            young = [sample[site] for sample in past[-1 - age :]]
            worst = max(young) if v[1 - site] > 0.0 else min(young)
            seen[site] = worst if rng.random() < 0.5 else rng.choice(young)
        force = np.array([coupling.force(np.array([e]))[0] for e in X - seen[::-1]])
        v_next = v - h / mass * (force + damping * v)
        step = 0.5 * h * (v + v_next)
        X, v = X + step, v_next
        past.append(X)
        moved = np.column_stack([moved[:, 1:], step])
    return np.array(energies)


@pytest.mark.parametrize("lopsided", [1.0, 3.0])
@pytest.mark.parametrize("ratio", [0.02, 1.96])
@pytest.mark.parametrize("ages", [(0, 0), (25, 5), (40, 40)])
def test_theorem_s_at_its_edge(ages: tuple[int, int], ratio: float, lopsided: float) -> None:
    W = sampled_energies(ages, ratio, 1.0, lopsided)
    assert np.diff(W).max() <= 1e-15 * W[0]
    assert W[-1] < 1e-3 * W[0]


def test_theorem_s_past_its_edges() -> None:
    W = sampled_energies((25, 5), 2.04, 1.0, 1.0)
    assert np.abs(W).max() > 1e9 * W[0]
    W = sampled_energies((40, 40), 0.02, 0.9, 1.0)
    assert np.diff(W).max() > 1e-7 * W[0]


# Section 10: what one site sees of the round trip may be little more than half of T.


def test_a_site_may_see_half_of_the_round_trip() -> None:
    def ticks_old(delay_s: float) -> int:
        return ceil(round(delay_s / PERIOD_S, 6))

    seen = 0
    for now in range(7000):
        back = ticks_old(0.1 - 0.1 * sin(now * PERIOD_S))
        there = ticks_old(0.1 + 0.1 * sin((now - back) * PERIOD_S))
        seen = max(seen, back + there)
    assert seen * PERIOD_S == pytest.approx(0.215)
