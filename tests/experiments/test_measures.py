"""Figures of runs, against hand computation and an independent evaluation."""

from dataclasses import replace
from math import atan, cos, hypot, inf, log, nan, pi, sin

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.case import Case
from experiments.measures import energy_trace_j, measure, settling_time_s
from experiments.simulation import Run, Simulation
from site_runtime.session import Session, StiffnessCoupling
from telemetry.rows import RowArray, row_dtype

FloatArray = npt.NDArray[np.float64]
NO_ENERGY = np.empty(0)
NO_TASK = Case("no_task", "theorems.toml", 0.3, {"remote.sub_tasks": None}).session()
GAIN = 50.0  # ten times the session's: the self-motion is then a good part of the energy
TASK = Case(
    "task",
    "theorems.toml",
    0.3,
    {"remote.sub_tasks[0].gain": GAIN, "remote.null_space": {"rate_limit_rad_s": inf}},
).session()
LENGTH_M, MASS_KG = 0.38, 0.3
OBSTACLE = {
    "name": "post",
    "center_m": [2 * LENGTH_M, -0.1],
    "collision_radius_m": 0.01,
    "safe_radius_m": 0.02,
}
POST = Case(
    "post",
    "theorems.toml",
    0.3,
    {"remote.sub_tasks": None, "remote.obstacles": [OBSTACLE]},
).session()


@pytest.fixture(scope="module")
def run() -> Run:
    return Simulation(TASK).run(0.3)


def rows_of(joints: int, ticks: int) -> RowArray:
    rows = np.zeros(ticks, row_dtype(joints, 2))
    rows["time_ns"] = np.arange(ticks) * 1_000_000
    for name in ("one_way_delay_s", "round_trip_s"):
        rows[name] = nan
    return rows


def made_up(ticks: int) -> Run:
    """A run at rest in which nothing is known, to write figures into."""
    return Run(rows_of(2, ticks), rows_of(3, ticks), ())


def figures(run: Run, session: Session = NO_TASK) -> dict[str, float]:
    return measure(session, run, NO_ENERGY)


@pytest.mark.parametrize(
    ("errors_m", "expected_s"),
    [
        ([3.0, 2.0, 1.0, 0.5], 2.0),
        ([3.0, 0.5, 2.0, 0.5], 3.0),
        ([1.0, 0.9], 0.0),
        ([0.5, 2.0], None),
        ([2.0, 2.0], None),
    ],
    ids=["falls", "comes back up once", "never above", "ends above", "always above"],
)
def test_the_error_has_settled_when_it_stays_within_the_limit(
    errors_m: list[float], expected_s: float | None
) -> None:
    time_s = np.arange(len(errors_m), dtype=float)
    assert settling_time_s(time_s, np.array(errors_m), 1.0) == expected_s


@given(errors_m=st.lists(st.floats(0.0, 2.0), min_size=1, max_size=30))
def test_from_then_on_it_is_within_and_not_earlier(errors_m: list[float]) -> None:
    time_s, error_m = 5.0 + np.arange(len(errors_m)), np.array(errors_m)
    settled_s = settling_time_s(time_s, error_m, 1.0)
    if settled_s is None:
        assert error_m[-1] > 1.0
        return
    assert (error_m[time_s >= settled_s] <= 1.0).all()
    assert settled_s == time_s[0] or error_m[time_s < settled_s][-1] > 1.0


@pytest.mark.parametrize("errors_m", [[2.0, 0.5, nan], [nan, nan], [inf, inf]])
def test_an_unknown_error_has_not_settled(errors_m: list[float]) -> None:
    assert settling_time_s(np.arange(len(errors_m), dtype=float), np.array(errors_m), 1.0) is None


def test_an_error_known_again_may_settle() -> None:
    assert settling_time_s(np.arange(3.0), np.array([0.1, nan, 0.2]), 1.0) == 2.0


def test_errors_by_hand() -> None:
    run = made_up(2001)
    # 3-4-5 triangles: 0.5, 0.25 and 0.4 m, from 1.3 s on 5 mm, from 1.8 s on 0.5 mm
    apart = np.repeat([0.1, 0.05, 0.08, 0.001, 0.0001], [500, 500, 300, 500, 201])
    run.local["position_m"] = np.stack([1.0 + 3.0 * apart, 2.0 + 4.0 * apart], axis=1)
    run.remote["position_m"] = (1.0, 2.0)
    found = figures(run)
    assert found["duration_s"] == 2.0
    assert found["error_start_m"] == found["error_max_m"] == pytest.approx(0.5)
    # Of the last 500 ticks, 299 were before 1.8 s.
    assert found["error_end_m"] == pytest.approx((299 * 5e-3 + 201 * 5e-4) / 500)
    assert found["error_second_quarter_m"] == pytest.approx(0.25)
    assert found["error_last_quarter_m"] == pytest.approx(5e-3)
    assert found["settled_1_cm_s"] == pytest.approx(1.3)
    assert found["settled_1_mm_s"] == pytest.approx(1.8)
    assert (found["local_position_end_x_m"], found["local_position_end_y_m"]) == pytest.approx(
        (1.0003, 2.0004)
    )
    assert (found["remote_position_end_x_m"], found["remote_position_end_y_m"]) == (1.0, 2.0)


def test_forces_torques_speeds_and_distances_by_hand() -> None:
    run = made_up(1001)
    run.local["external_force_n"][501:] = (3.0, 0.0)
    run.remote["external_force_n"][501:] = (-1.0, 1.5)
    run.local["external_force_n"][:501] = run.remote["external_force_n"][:501] = 99.0
    run.local["torque_nm"][7] = (0.5, -2.5)
    run.remote["torque_nm"][8, 2] = 1.5
    run.local["q_dot"][9, 1] = -4.0
    run.remote["q_dot"][9, 1] = 3.0
    run.local["coupling_force_n"][3, 1] = -6.0
    run.remote["coupling_force_n"][3, 0] = 5.0
    run.local["q"][:, 1] = pi / 2
    run.local["q"][[0, 500], 1] = pi / 6, 0.1
    run.remote["q"][:] = (0.0, pi / 2, 0.0)  # from the elbow on, up
    run.remote["q"][[0, 500]] = (0.0, 0.0, pi / 2), (0.0, 0.0, 0.1)
    run.remote["sub_task_error_rad_s"] = 1.0
    run.remote["sub_task_error_rad_s"][[0, 400]] = 2.0, 8.0
    run.local["round_trip_s"][[3, 600]] = 0.1, 0.25
    run.local["one_way_delay_s"][3] = 0.1
    run.remote["one_way_delay_s"][4] = 0.15
    run.local["certified_round_trip_s"] = 0.6
    expected = {
        "force_sum_end_n": 2.5,
        "local_external_force_end_x_n": 3.0,
        "local_external_force_end_y_n": 0.0,
        "remote_external_force_end_x_n": -1.0,
        "remote_external_force_end_y_n": 1.5,
        "local_torque_max_nm": 2.5,
        "remote_torque_max_nm": 1.5,
        "local_joint_speed_max_rad_s": 4.0,
        "remote_joint_speed_max_rad_s": 3.0,
        "local_coupling_force_max_n": 6.0,
        "remote_coupling_force_max_n": 5.0,
        "local_manipulability_start": LENGTH_M**4 / 4,
        "local_manipulability_end": LENGTH_M**4,
        "local_manipulability_min": LENGTH_M**4 * sin(0.1) ** 2,
        "remote_manipulability_start": 6 * LENGTH_M**4,
        "remote_manipulability_end": 5 * LENGTH_M**4,
        "remote_manipulability_min": 6 * LENGTH_M**4 * sin(0.1) ** 2,
        "sub_task_error_start_rad_s": 2.0,
        "sub_task_error_max_rad_s": 8.0,
        "sub_task_error_end_rad_s": 1.0,
        "midpoint_distance_min_m": hypot(LENGTH_M / 2, 0.1),
        "link_distance_min_m": 0.1,
        "round_trip_max_s": 0.25,
        "local_age_max_s": 0.1,
        "remote_age_max_s": 0.15,
        "certified_round_trip_s": 0.6,
    }
    found = figures(run, POST)
    assert {name: found[name] for name in expected} == pytest.approx(expected)


def test_what_is_unknown_throughout_is_nan() -> None:
    run = made_up(10)
    run.local["position_m"] = 1.0  # never within a centimetre
    unknown = {name for name, value in figures(run).items() if np.isnan(value)}
    assert unknown == {
        *("settled_1_cm_s", "settled_1_mm_s", "round_trip_max_s", "local_age_max_s"),
        *("remote_age_max_s", "midpoint_distance_min_m", "link_distance_min_m"),
    }


def test_a_diverged_run_is_not_taken_for_a_settled_one() -> None:
    run = made_up(10)
    run.local["position_m"][5:] = nan
    found = figures(run)
    assert np.isnan(found["settled_1_mm_s"])
    assert np.isnan(found["error_max_m"])


def test_a_run_without_rows_has_no_figures() -> None:
    assert measure(TASK, made_up(0), NO_ENERGY) == {}
    assert energy_trace_j(TASK, made_up(0), (0.2, 0.2)).shape == (0,)


def test_a_run_of_one_tick_has_figures() -> None:
    run = Simulation(TASK).run(0.0)
    energy_j = energy_trace_j(TASK, run, (0.2, 0.2))
    found = measure(TASK, run, energy_j)
    assert found["duration_s"] == found["energy_rise_j"] == found["energy_tick_tolerance_j"] == 0.0
    assert found["energy_start_j"] == found["energy_end_j"] > 0.0


# The planar arm with point masses at the tips, written out: link i turns by q_1 + … + q_i.


def tip_jacobian(q: FloatArray, links: int) -> FloatArray:
    """Jacobian (2, n) of the tip of a link."""
    angles = np.cumsum(q)
    columns = np.zeros((2, len(q)))
    for joint in range(links):
        for link in range(joint, links):
            columns[:, joint] += LENGTH_M * np.array([-sin(angles[link]), cos(angles[link])])
    return columns


def inertia(q: FloatArray) -> FloatArray:
    tips = [tip_jacobian(q, links) for links in range(1, len(q) + 1)]
    return MASS_KG * sum((J.T @ J for J in tips), np.zeros((len(q), len(q))))


def index(q: FloatArray) -> float:
    J = tip_jacobian(q, len(q))
    return float(np.linalg.det(J @ J.T))


def self_motion(q: FloatArray) -> FloatArray:
    """ζ of (4) times w/(w + ε): the index's gradient without its part in the rows of J."""
    step = 1e-5
    gradient = np.array(
        [(index(q + d) - index(q - d)) / (2.0 * step) for d in step * np.eye(len(q))]
    )
    null = np.linalg.svd(tip_jacobian(q, len(q)))[2][2:]
    share = index(q) / (index(q) + TASK.remote.null_space.regularisation)
    return GAIN * share * null.T @ (null @ gradient)


def potential(error: FloatArray, coupling: StiffnessCoupling) -> float:
    """∫ Kδ atan(e/δ) de [J]."""
    total = 0.0
    for e, k, ceiling in zip(
        error, coupling.stiffness_n_per_m, coupling.force_ceiling_n, strict=True
    ):
        width = 2.0 * ceiling / (pi * k)
        total += k * width * (e * atan(e / width) - 0.5 * width * log(1.0 + (e / width) ** 2))
    return total


def in_transit(powers: FloatArray, period_s: float, window_s: float) -> float:
    """½∫_{−d̄}^0∫_{t+γ}^t w dη dγ = ½∫_{t−d̄}^t (η − t + d̄)w dη, by Simpson's rule."""
    time_s = np.arange(len(powers)) * period_s
    fine_s = np.linspace(time_s[0], time_s[-1], 2 * len(powers) - 1)
    weight = np.maximum(fine_s - time_s[-1] + window_s, 0.0)
    values = weight * np.interp(fine_s, time_s, powers)
    if len(powers) < 2:
        return 0.0
    return 0.5 * period_s / 6.0 * float((values[:-1:2] + 4.0 * values[1::2] + values[2::2]).sum())


@pytest.mark.parametrize("window_s", [(0.2, 0.25), (0.05, 0.1)])
def test_the_energy_is_that_of_the_formulas_written_out(
    run: Run, window_s: tuple[float, float]
) -> None:
    coupling = TASK.coupling
    assert isinstance(coupling, StiffnessCoupling)
    energy_j = energy_trace_j(TASK, run, window_s)
    stiffness = np.array(coupling.stiffness_n_per_m)
    powers = [np.square(rows["velocity_m_s"]) @ stiffness for rows in (run.local, run.remote)]
    for tick in (0, 1, 2, 150, 300):
        local, remote = run.local[tick], run.remote[tick]
        s = remote["q_dot"] - self_motion(remote["q"])
        expected_j = (
            0.5 * local["q_dot"] @ inertia(local["q"]) @ local["q_dot"]
            + 0.5 * s @ inertia(remote["q"]) @ s
            + potential(local["position_m"] - remote["position_m"], coupling)
            + sum(
                in_transit(power[: tick + 1], 1e-3, window)
                for power, window in zip(powers, window_s, strict=True)
            )
        )
        # The window's end falls between two samples once it is shorter than the past.
        assert energy_j[tick] == pytest.approx(expected_j, rel=1e-7)


def test_the_energy_s_figures(run: Run) -> None:
    energy_j = np.full(len(run.local), 1.0)
    energy_j[:6] = 5.0, 3.0, 4.0, 2.0, 3.5, 3.75
    found = measure(TASK, run, energy_j)
    assert found["energy_start_j"] == 5.0
    assert found["energy_end_j"] == 1.0
    assert found["energy_rise_j"] == 1.75  # from 2 to 3.75
    assert found["energy_tick_rise_j"] == 1.5


def test_the_tolerance_is_the_largest_kinetic_energy_of_a_tick_s_step(run: Run) -> None:
    largest_j = 0.0
    for now in range(len(run.local) - 1):
        step_j = 0.0
        for rows in (run.local, run.remote):
            step = rows["q_dot"][now + 1] - rows["q_dot"][now]
            step_j += 0.5 * step @ inertia(rows["q"][now]) @ step
        largest_j = max(largest_j, step_j)
    found = measure(TASK, run, np.ones(len(run.local)))
    assert found["energy_tick_tolerance_j"] == pytest.approx(largest_j, rel=1e-9)


def test_the_tolerance_weighs_steps_by_inertia() -> None:
    run = made_up(4)
    # Stretched, a step of the first joint weighs 2.5 ml²; folded, the larger step weighs 0.5 ml².
    run.local["q"] = [(0.0, 0.0), (0.0, pi), (0.0, pi), (0.0, pi)]
    run.local["q_dot"] = [(0.0, 0.0), (1.0, 0.0), (2.5, 0.0), (2.5, 0.0)]
    found = measure(NO_TASK, run, np.ones(4))
    assert found["energy_tick_tolerance_j"] == pytest.approx(2.5 * MASS_KG * LENGTH_M**2)


def test_the_tolerance_adds_the_sites_tick_by_tick() -> None:
    run = made_up(4)
    # A step of the last joint weighs ½ml² at either site.
    run.local["q_dot"][:, 1] = 0.0, 2.0, 2.0, 3.0
    run.remote["q_dot"][:, 2] = 0.0, 0.0, 1.0, 2.5
    found = measure(NO_TASK, run, np.ones(4))
    unit_j = 0.5 * MASS_KG * LENGTH_M**2
    assert found["energy_tick_tolerance_j"] == pytest.approx(4.0 * unit_j)


def test_the_self_motion_is_that_of_the_paper_s_formula_and_unseen(run: Run) -> None:
    found = measure(TASK, run, NO_ENERGY)
    speeds = [float(np.linalg.norm(self_motion(row["q"]))) for row in run.remote]
    assert found["null_space_speed_start_rad_s"] == pytest.approx(speeds[0], rel=1e-6)
    assert found["null_space_speed_max_rad_s"] == pytest.approx(max(speeds), rel=1e-6)
    assert found["null_space_speed_max_rad_s"] > 0.2
    assert 0.0 < found["null_space_leak_m_s"] < 1e-14


def test_without_a_sub_task_there_is_no_self_motion(run: Run) -> None:
    found = measure(NO_TASK, run, NO_ENERGY)
    assert [value for name, value in found.items() if name.startswith("null")] == [0.0, 0.0, 0.0]


def test_a_projector_that_leaks_shows(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def damped(
        J: FloatArray, _J_dot: FloatArray, g: FloatArray, g_dot: FloatArray, _: float
    ) -> tuple[FloatArray, FloatArray]:
        gram = J @ J.T + 0.05**2 * np.eye(len(J))
        return g - J.T @ np.linalg.solve(gram, J @ g), g_dot

    monkeypatch.setattr("remote_site.controller.null_space_velocity", damped)
    assert measure(TASK, run, NO_ENERGY)["null_space_leak_m_s"] > 1e-4


def test_a_ramped_sub_task_is_measured_as_it_was_driven() -> None:
    session: Session = replace(TASK, engagement=replace(TASK.engagement, sub_task_ramp_s=0.2))
    ramped = measure(session, Simulation(session).run(0.1), NO_ENERGY)
    assert ramped["null_space_speed_start_rad_s"] == 0.0
    assert 0.0 < ramped["null_space_speed_max_rad_s"] < 0.2
