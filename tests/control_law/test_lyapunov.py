"""V against its definition, and V along certified and uncertified motions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from control_law.certificates import SiteGains, best, required_task_damping_theorem_b
from control_law.control import control_torque
from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.lyapunov import LyapunovKrasovskii, SiteMotion
from control_law.null_space import null_space_velocity
from control_law.sub_tasks.manipulability import ManipulabilityAscent

FloatArray = npt.NDArray[np.float64]


COUPLING = Coupling.from_stiffness(np.full(2, 50.0), np.full(2, 5.0))


def at_rest(n: int = 2) -> SiteMotion:
    return SiteMotion(np.zeros(n), np.eye(n), np.zeros(2))


def moving(X_dot: FloatArray) -> SiteMotion:
    return SiteMotion(np.zeros(2), np.eye(2), X_dot)


def test_kinetic_and_coupling_energy() -> None:
    V = LyapunovKrasovskii(COUPLING, 0.2, 0.2)
    M, s, error = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.0, -2.0]), np.array([0.1, -0.2])
    energy = V.update(
        SiteMotion(s, M, np.zeros(2)), SiteMotion(3 * s, M, np.zeros(2)), error, 0.001
    )
    assert energy.kinetic == pytest.approx(5 * s @ M @ s)
    assert energy.coupling == pytest.approx(COUPLING.energy(error))
    assert energy.transit == 0.0
    assert energy.total == pytest.approx(energy.kinetic + energy.coupling)


@pytest.mark.parametrize(("alpha", "gamma"), [(1.0, 1.0), (2.0, 0.3)])
def test_transit_energy_is_the_double_integral(alpha: float, gamma: float) -> None:
    delay_l, delay_r, dt, end = 0.13, 0.2004, 1e-3, 1.0
    V = LyapunovKrasovskii(COUPLING, delay_l, delay_r, alpha, gamma)

    def X_dot_l(t: float | FloatArray) -> FloatArray:
        return np.array([np.sin(5 * t), 0.3 + 0 * t]) * (t >= 0)

    def X_dot_r(t: float | FloatArray) -> FloatArray:
        return np.array([t, np.cos(9 * t)]) * (t >= 0)

    transit = {}
    for k in range(round(end / dt) + 1):
        t = k * dt
        energy = V.update(moving(X_dot_l(t)), moving(X_dot_r(t)), np.zeros(2), dt if k else 0.0)
        transit[k] = energy.transit

    def brute(X_dot: Callable[..., FloatArray], delay: float, t: float, cells: int = 400) -> float:
        """∫_{−d̄}^0∫_{t+γ'}^t ẊᵀKẊ dη dγ' by two nested midpoint rules."""
        total = 0.0
        for lag in (np.arange(cells) + 0.5) * delay / cells:
            eta = t - lag + (np.arange(cells) + 0.5) * lag / cells
            total += 50.0 * np.square(X_dot(eta)).sum() * lag / cells * delay / cells
        return total

    for k in (60, 700, 1000):
        t = k * dt
        expected = brute(X_dot_r, delay_r, t) / (2 * alpha) + brute(X_dot_l, delay_l, t) / (
            2 * gamma
        )
        assert transit[k] == pytest.approx(expected, rel=5e-3)


def test_transit_energy_fades_once_the_motion_has_arrived() -> None:
    V = LyapunovKrasovskii(COUPLING, 0.1, 0.1)
    V.update(moving(np.ones(2)), at_rest(), np.zeros(2), 0.0)
    energies = [V.update(at_rest(), at_rest(), np.zeros(2), 1e-3).transit for _ in range(150)]
    assert energies[0] > 0
    assert energies[-1] == pytest.approx(0.0, abs=1e-15)
    assert (np.diff(energies[1:]) <= 1e-15).all()


def test_no_delay_holds_no_energy() -> None:
    V = LyapunovKrasovskii(COUPLING, 0.0, 0.0)
    for _ in range(5):
        assert V.update(moving(np.ones(2)), moving(np.ones(2)), np.zeros(2), 1e-3).transit == 0.0


@pytest.mark.parametrize("kwargs", [{"alpha": 0.0}, {"gamma": -1.0}])
def test_refuses_weights_that_are_not_positive(kwargs: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="positive"):
        LyapunovKrasovskii(COUPLING, 0.1, 0.1, **kwargs)


def test_refuses_a_negative_delay() -> None:
    with pytest.raises(ValueError, match="window"):
        LyapunovKrasovskii(COUPLING, -0.1, 0.1)


MAX_DELAY_S = 0.2
DELAYS = {
    "constant": lambda t, rng: MAX_DELAY_S,
    "sinusoid": lambda t, rng: 0.5 * MAX_DELAY_S * (1 + np.sin(7 * t)),
    "random": lambda t, rng: rng.uniform(0, MAX_DELAY_S),
}


def free_motion(
    planar_chain: Callable[..., Any],
    task_damping: float,
    delay: Callable[..., float],
    end_s: float,
    climb: float = 0.0,
    dt: float = 1e-3,
) -> tuple[FloatArray, FloatArray]:
    """V every step of a 2R local and a 3R remote arm let go 57 cm apart."""
    chains = planar_chain(2), planar_chain(3)
    qs = [np.array([0.4, 1.4]), np.array([1.2, -0.7, -0.9])]
    q_dots = [np.zeros(2), np.zeros(3)]
    floors = (np.full(2, 0.05), np.full(3, 0.05))
    dampings = [Damping(floor, np.full(2, task_damping)) for floor in floors]
    rng, sub_task = np.random.default_rng(0), ManipulabilityAscent(climb)
    V = LyapunovKrasovskii(COUPLING, MAX_DELAY_S, MAX_DELAY_S)
    history, totals, errors = [], [], []
    for k in range(round(end_s / dt)):
        terms = [c.terms(q, v) for c, q, v in zip(chains, qs, q_dots, strict=True)]
        history.append([t.X for t in terms])
        motions = []
        for side, t in enumerate(terms):
            late = history[max(0, k - round(delay(k * dt, rng) / dt))][1 - side]
            zeta = zeta_dot = np.zeros(len(t.q))
            if side and climb:
                zeta, zeta_dot = null_space_velocity(t.J, t.J_dot, *sub_task.evaluate(t), 1e-4)
            torque, s = control_torque(
                t, COUPLING.force(t.X - late), dampings[side], zeta, zeta_dot
            )
            q_ddot = np.linalg.solve(t.M, torque - t.C @ t.q_dot - t.G)
            q_dots[side] = t.q_dot + dt * q_ddot
            qs[side] = t.q + dt * q_dots[side]
            motions.append(SiteMotion(s, t.M, t.X_dot))
        error = terms[0].X - terms[1].X
        totals.append(V.update(*motions, error, dt if k else 0.0).total)
        errors.append(np.linalg.norm(error))
    return np.array(totals), np.array(errors)


CERTIFIED = float(required_task_damping_theorem_b(2 * MAX_DELAY_S, COUPLING)[0])


def greatest_rise(totals: FloatArray) -> float:
    return (totals - np.minimum.accumulate(totals)).max()


@pytest.mark.parametrize(
    ("delay", "climb"), [("constant", 0.0), ("sinusoid", 0.0), ("random", 0.0), ("random", 5.0)]
)
def test_never_rises_on_a_certified_free_motion(
    planar_chain: Callable[..., Any], delay: str, climb: float
) -> None:
    totals, errors = free_motion(planar_chain, CERTIFIED, DELAYS[delay], 1.5, climb)
    assert greatest_rise(totals) < 1e-9 * totals[0]
    assert errors[-1] < 0.2 * errors[0]


def test_rises_with_a_quarter_of_the_certified_damping(planar_chain: Callable[..., Any]) -> None:
    totals, _ = free_motion(planar_chain, 0.25 * CERTIFIED, DELAYS["constant"], 1.5)
    assert greatest_rise(totals) > 0.01 * totals[0]


def test_the_motion_above_is_certified() -> None:
    sites = [
        SiteGains(Damping(np.full(n, 0.05), np.full(2, CERTIFIED)), 0.38 * np.arange(n, 0.0, -1.0))
        for n in (2, 3)
    ]
    assert best(COUPLING, *sites).round_trip_s == pytest.approx(2 * MAX_DELAY_S)
