"""The simulated arm: its physics, its integrators, its imperfections, its time."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from control_law.sampling import (
    LIMIT_IMMEDIATE,
    LIMIT_LATE_DIFFERENCE,
    LIMIT_LATE_EXACT,
    damping_ratio,
)
from hardware.interface import (
    ContactForce,
    DeviceConfigurationError,
    DeviceError,
    FloatArray,
    VelocityByDifference,
)
from hardware.robot_model import PlanarArm, RobotModel, build_robot
from hardware.simulated import SimulatedDevice, SimulatedSettings

MS = 1_000_000


class Clock:
    """A clock that moves when told."""

    def __init__(self, ns: int = 0) -> None:
        self.ns = ns

    def __call__(self) -> int:
        return self.ns


class Push:
    """A contact that keeps what it was asked."""

    def __init__(self, law: Callable[[float, FloatArray, FloatArray], FloatArray]) -> None:
        self.law = law
        self.asked: list[tuple[float, FloatArray, FloatArray]] = []

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        self.asked.append((time_s, position_m, velocity_m_s))
        return self.law(time_s, position_m, velocity_m_s)


def constant(*force_n: float) -> Push:
    return Push(lambda t, X, X_dot: np.array(force_n))


def wall(t: float, X: FloatArray, X_dot: FloatArray) -> FloatArray:
    """A spring wall at x = 0.3 m, and a steady push along y."""
    return np.array([-500.0 * max(X[0] - 0.3, 0.0), 0.4])


def planar(joints: int, mass: str = "rod", gravity: tuple[float, float] = (0, 0)) -> RobotModel:
    arm = PlanarArm("planar", (0.38,) * joints, (0.3,) * joints, mass, gravity)  # type: ignore[arg-type]
    return build_robot(arm, None)


BAR_KG_M2 = 0.3 * 0.38**2 / 3.0  # one rod about its end


def running(
    model: RobotModel,
    contact: ContactForce | None = None,
    *,
    seed: int = 0,
    start_ns: int = 0,
    initial: tuple[float, ...] | None = None,
    **options: object,
) -> tuple[SimulatedDevice, Clock]:
    """A device, enabled, on a clock of its own that stands at session time zero."""
    clock = Clock(start_ns)
    settings = SimulatedSettings(initial or (0.4,) * model.joints, **options)  # type: ignore[arg-type]
    device = SimulatedDevice(model, settings, contact, clock, start_ns, seed)
    device.open()
    device.enable()
    return device, clock


def ticks(device: SimulatedDevice, clock: Clock, count: int, ns: int = MS) -> FloatArray:
    """Let time pass; positions and velocities, (count, 2, n)."""
    rows = []
    for _ in range(count):
        clock.ns += ns
        state = device.read()
        rows.append((state.position_rad, state.velocity_rad_s))
    return np.array(rows)


def energy_j(model: RobotModel, q: FloatArray, q_dot: FloatArray, gravity: float = 0.0) -> float:
    """Kinetic and potential energy of an arm of uniform rods, gravity along −y."""
    points = model.chain(q)
    height = 0.5 * (points[1:, 1] + points[:-1, 1])
    return float(0.5 * q_dot @ model.terms(q, q_dot).M @ q_dot + 0.3 * gravity * height.sum())


# Physics and integrators.


def test_a_free_swing_keeps_its_energy() -> None:
    model = planar(3, gravity=(0.0, -9.81))
    device, clock = running(model, integrator="rk4", initial=(0.4, 0.3, -0.2))
    path = ticks(device, clock, 3000)
    energies = [energy_j(model, q, q_dot, 9.81) for q, q_dot in path[::50]]
    assert np.ptp(path[:, 0, 0]) > 1.0
    np.testing.assert_allclose(
        energies, energy_j(model, np.array([0.4, 0.3, -0.2]), np.zeros(3), 9.81), atol=1e-6
    )


@pytest.mark.parametrize(("integrator", "order"), [("semi-implicit", 1), ("rk4", 4)])
def test_integrators_have_their_order(integrator: str, order: int) -> None:
    model = planar(2, gravity=(0.0, -9.81))

    def swaying(t: float, X: FloatArray, X_dot: FloatArray) -> FloatArray:
        return np.array([math.sin(20.0 * t), 0.5]) - 2.0 * X_dot

    def end(step_ms: float, method: str = integrator) -> FloatArray:
        device, clock = running(model, Push(swaying), integrator=method, step_s=step_ms * 1e-3)
        return np.asarray(ticks(device, clock, 10, 40 * MS)[-1])

    exact = end(0.25, "rk4")
    coarse, fine = (np.abs(end(step) - exact).max() for step in (4.0, 2.0))
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_contact_work_equals_the_energy_gained(integrator: str) -> None:
    model = planar(2)
    device, clock = running(
        model, Push(wall), integrator=integrator, step_s=1e-4, initial=(0.2, 1.6)
    )
    power = []
    for _ in range(6000):
        clock.ns += 100_000
        state = device.read()
        X_dot = model.end_effector(state.position_rad, state.velocity_rad_s)[1]
        power.append(state.wrench[:2] @ X_dot)
    work = float(np.sum(power)) * 1e-4
    gained = energy_j(model, state.position_rad, state.velocity_rad_s)
    assert np.ptp(power) > 0.1
    assert work == pytest.approx(gained, rel=2e-2)


def test_the_wrench_is_the_force_on_the_robot_now() -> None:
    contact = Push(lambda t, X, X_dot: np.array([t, X[0]]) + X_dot)
    model = planar(2)
    device, clock = running(model, contact)
    ticks(device, clock, 30)
    clock.ns += MS
    state = device.read()
    X, X_dot, _ = model.end_effector(state.position_rad, state.velocity_rad_s)
    np.testing.assert_allclose(state.wrench[:2], np.array([0.031, X[0]]) + X_dot)
    np.testing.assert_array_equal(state.wrench[2:], 0.0)
    assert np.abs(X_dot).max() > 0.0


def test_a_push_moves_the_arm_its_way() -> None:
    model = planar(2)
    device, clock = running(model, constant(0.0, 1.0))
    state = ticks(device, clock, 50)[-1]
    assert model.end_effector(*state)[1][1] > 0.0


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_torque_is_held_between_writes(integrator: str) -> None:
    device, clock = running(planar(1), integrator=integrator)
    device.read()
    torque = np.array([0.01])
    device.write(torque)
    torque[:] = 9.0  # the caller's array is the caller's
    velocity = ticks(device, clock, 20)[-1, 1]
    assert velocity[0] == pytest.approx(0.01 / BAR_KG_M2 * 0.02)


# Friction.


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_viscous_friction_slows_exponentially(integrator: str) -> None:
    device, clock = running(planar(1), integrator=integrator, viscous_friction_nm_s=0.05)
    device.write(np.array([0.1]))
    before = ticks(device, clock, 100)[-1, 1, 0]
    device.write(np.zeros(1))
    after = ticks(device, clock, 200)[-1, 1, 0]
    expected = math.exp(-0.05 / BAR_KG_M2 * 0.2)
    assert after / before == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_coulomb_friction_stops_a_bar_in_the_textbook_time(integrator: str) -> None:
    friction = 0.02
    device, clock = running(planar(1), integrator=integrator, coulomb_friction_nm=friction)
    device.write(np.array([0.1]))
    position, velocity = ticks(device, clock, 100)[-1, :, 0]
    assert velocity == pytest.approx((0.1 - friction) / BAR_KG_M2 * 0.1)
    device.write(np.zeros(1))
    deceleration = friction / BAR_KG_M2
    stop_ticks = math.ceil(velocity / deceleration * 1e3)
    path = ticks(device, clock, stop_ticks + 200)[:, :, 0]
    travelled = path[-1, 0] - position
    assert travelled == pytest.approx(velocity**2 / (2.0 * deceleration), rel=1e-2)
    assert (path[:, 1] >= -1e-15).all()  # it never turns round
    assert abs(path[stop_ticks - 2, 1]) > 1e-3
    np.testing.assert_allclose(path[stop_ticks:, 1], 0.0, atol=1e-15)


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_coulomb_friction_lets_go_just_above_its_limit(integrator: str) -> None:
    for torque, moves in ((0.0199, False), (0.0201, True)):
        device, clock = running(planar(1), integrator=integrator, coulomb_friction_nm=0.02)
        device.write(np.array([torque]))
        travelled = float(ticks(device, clock, 500)[-1, 0, 0]) - 0.4
        assert (travelled > 1e-4) is moves
        assert moves or abs(travelled) < 1e-15


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_coulomb_friction_holds_an_arm_against_gravity(integrator: str) -> None:
    model = planar(3, gravity=(0.0, -9.81))
    load = np.abs(model.terms(np.full(3, 0.4), np.zeros(3)).G).max()
    device, clock = running(model, integrator=integrator, coulomb_friction_nm=1.2 * load)
    path = ticks(device, clock, 1000)
    np.testing.assert_allclose(path[:, 0], 0.4, atol=2e-4)
    # Once found, the holding torque is exact: no creep.
    np.testing.assert_allclose(path[-1, 0], path[200, 0], atol=1e-9)


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_coulomb_friction_only_takes_energy_until_all_is_still(integrator: str) -> None:
    model = planar(3, "point")
    device, clock = running(model, integrator=integrator, coulomb_friction_nm=0.1)
    device.write(np.array([0.8, -0.4, 0.6]))
    ticks(device, clock, 40)
    device.write(np.zeros(3))
    path = ticks(device, clock, 1500)
    energies = np.array(
        [0.5 * q_dot @ model.terms(q, q_dot).M @ q_dot for q, q_dot in path],
    )
    assert energies[0] > 0.01
    assert np.diff(energies).max() < 1e-9
    assert np.abs(path[-1, 1]).max() < 1e-12


@pytest.mark.parametrize("sweeps", [0, 1, 20])
def test_coulomb_friction_takes_energy_however_early_its_search_ends(
    sweeps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hardware.simulated.FRICTION_SWEEPS", sweeps)
    device, _ = running(planar(3, "point"), coulomb_friction_nm=0.5)
    random = np.random.default_rng(0)
    for _ in range(200):
        device._q_dot = random.standard_normal(3)
        before = random.standard_normal(3)
        after_free = device._q_dot + 0.001 * before
        friction, change = device._coulomb_friction(before, 0.001)
        # ½v'ᵀMv' − ½vᵀMv with v' = v + h M⁻¹ f
        gained = 0.001 * friction @ (after_free + 0.5 * 0.001 * change)
        assert gained <= 1e-15
        assert np.abs(friction).max() <= 0.5
        # What it finds is also the start of its next search: leave it a misleading one.
        device._friction = random.uniform(-0.5, 0.5, 3)


# Imperfect sensors and actuators.


def test_encoders_count_in_whole_steps() -> None:
    exact, exact_clock = running(planar(2))
    coarse, coarse_clock = running(planar(2), encoder_resolution_rad=1e-3)
    for device in (exact, coarse):
        device.write(np.array([0.05, -0.02]))
    truth, measured = ticks(exact, exact_clock, 200), ticks(coarse, coarse_clock, 200)
    counts = measured[:, 0] / 1e-3
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(measured[:, 0] - truth[:, 0]).max() <= 0.5e-3 * (1.0 + 1e-9)
    assert len(np.unique(counts[:, 0])) > 20


def test_encoder_velocity_is_a_filtered_difference() -> None:
    device, clock = running(planar(1), encoder_resolution_rad=1e-2, velocity_filter_s=0.003)
    first = device.read()
    device.write(np.array([1.0]))
    path = np.concatenate([[[first.position_rad, first.velocity_rad_s]], ticks(device, clock, 50)])[
        :, :, 0
    ]
    assert path[0, 1] == 0.0
    expected = 0.0
    for (before, _), (after, velocity) in itertools.pairwise(path):
        expected += 0.001 / (0.001 + 0.003) * ((after - before) / 0.001 - expected)
        assert velocity == pytest.approx(expected, abs=1e-9)
    assert np.ptp(path[:, 1]) > 1.0


def test_the_settings_tell_whether_velocity_is_a_filtered_difference() -> None:
    exact = SimulatedSettings((0.0,), velocity_filter_s=0.003)
    encoder = SimulatedSettings((0.0,), encoder_resolution_rad=1e-3, velocity_filter_s=0.003)
    assert isinstance(exact, VelocityByDifference)
    assert exact.difference_filter_s is None
    assert encoder.difference_filter_s == 0.003


def test_reading_twice_at_one_instant_changes_nothing() -> None:
    device, clock = running(planar(2), constant(1.0, 0.0), encoder_resolution_rad=1e-4)
    ticks(device, clock, 20)
    one, two = device.read(), device.read()
    np.testing.assert_array_equal(one.position_rad, two.position_rad)
    np.testing.assert_array_equal(one.velocity_rad_s, two.velocity_rad_s)
    assert one.stamp_ns == two.stamp_ns


def test_actuators_saturate() -> None:
    device, clock = running(planar(1), torque_limit_nm=0.01)
    device.write(np.array([5.0]))
    assert ticks(device, clock, 1)[-1, 1, 0] == pytest.approx(0.01 / BAR_KG_M2 * 0.001)
    device.write(np.array([-5.0]))
    assert ticks(device, clock, 1)[-1, 1, 0] == pytest.approx(0.0, abs=1e-15)


def test_any_finite_torque_is_taken_and_no_other() -> None:
    device, clock = running(planar(2), torque_limit_nm=0.01)
    device.write(np.array([1e200, -1e200]))
    assert ticks(device, clock, 1)[-1, 1, 0] > 0.0
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(DeviceError, match="not finite"):
            device.write(np.array([0.0, bad]))


def test_noise_has_the_size_asked_for() -> None:
    device, clock = running(planar(2), velocity_noise_rad_s=0.2, force_noise_n=0.5)
    states = []
    for _ in range(2000):
        clock.ns += MS
        states.append(device.read())
    velocity = np.array([state.velocity_rad_s for state in states])
    wrench = np.array([state.wrench for state in states])
    assert velocity.std() == pytest.approx(0.2, rel=0.1)
    assert wrench[:, :2].std() == pytest.approx(0.5, rel=0.1)
    np.testing.assert_array_equal(wrench[:, 2:], 0.0)
    np.testing.assert_array_equal([state.position_rad for state in states], 0.4)  # not felt


# Late actuators.


def driven(device: SimulatedDevice, clock: Clock, torques_nm: FloatArray, ns: int) -> FloatArray:
    """A new torque at every reading; the velocities it is read with, (count, n)."""
    velocities = []
    for torque_nm in torques_nm:
        velocities.append(device.read().velocity_rad_s)
        device.write(torque_nm)
        clock.ns += ns
    return np.array(velocities)


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
@pytest.mark.parametrize("delay_s", [0.0, 3e-4, 0.001, 0.0035, 0.02])
@pytest.mark.parametrize("ns", [MS, 7 * MS])
def test_torque_acts_on_time(ns: int, delay_s: float, integrator: str) -> None:
    torques_nm = 0.1 * np.random.default_rng(5).standard_normal((40, 1))
    device, clock = running(planar(1), integrator=integrator, torque_delay_s=delay_s)
    velocity = driven(device, clock, torques_nm, ns)[:, 0]
    # A free bar moves as it would have at once, that much later.
    time_s = ns * 1e-9 * np.arange(40)
    at_once = np.cumsum([0.0, *torques_nm[:-1, 0]]) * ns * 1e-9 / BAR_KG_M2
    expected = np.interp(time_s - delay_s, time_s, at_once)
    assert np.ptp(expected) > 1e-2
    np.testing.assert_allclose(velocity, expected, 0.0, 1e-12)


@pytest.mark.parametrize("ticks_late", [0, 3])
def test_a_delay_of_whole_ticks_only_shifts_bit_for_bit(ticks_late: int) -> None:
    torques_nm = 0.1 * np.random.default_rng(6).standard_normal((200, 3))
    nothing = np.zeros((ticks_late, 3))

    def run(torques_nm: FloatArray, delay_s: float) -> FloatArray:
        device, clock = running(
            planar(3, "point"), Push(wall), coulomb_friction_nm=0.01, torque_delay_s=delay_s
        )
        return driven(device, clock, torques_nm, MS)

    np.testing.assert_array_equal(
        run(torques_nm, 0.001 * ticks_late),
        run(np.concatenate([nothing, torques_nm])[:200], 0.0),
    )


@pytest.mark.parametrize("again", ["stop", "enable", "reopen"])
def test_no_torque_on_its_way_survives(again: str) -> None:
    device, clock = running(planar(1), torque_delay_s=0.0025, brakes=False)
    device.write(np.array([0.1]))
    ticks(device, clock, 3)
    device.write(np.array([0.2]))  # the first acts by now, this is on its way
    before = ticks(device, clock, 1)[-1, 1]
    assert before[0] > 0.0
    if again == "reopen":
        device.close()
        device.open()
        before = np.zeros(1)
    if again == "stop":
        device.stop()
    else:
        device.enable()
    np.testing.assert_array_equal(ticks(device, clock, 10)[:, 1], np.broadcast_to(before, (10, 1)))


def test_a_torque_due_in_skipped_time_acts_after_it() -> None:
    device, clock = running(planar(1), torque_delay_s=0.01)
    device.write(np.array([0.01]))
    clock.ns += 1050 * MS
    velocity = device.read().velocity_rad_s
    assert velocity[0] == pytest.approx(0.01 / BAR_KG_M2 * 0.05)


@pytest.mark.parametrize(
    ("delay_s", "resolution_rad", "limit"),
    [
        (0.0, 0.0, LIMIT_IMMEDIATE),
        (0.0, 1e-15, LIMIT_IMMEDIATE),
        (0.001, 0.0, LIMIT_LATE_EXACT),
        (0.001, 1e-15, LIMIT_LATE_DIFFERENCE),
        # Part of a period f: z² − (1 − (1 − f) a) z + f a has its roots inside the circle iff
        # a < 1/f, for f ≥ ½.
        (0.00075, 0.0, 4.0 / 3.0),
        (0.0005, 0.0, 2.0),
    ],
)
@pytest.mark.parametrize(("of_limit", "stable"), [(0.995, True), (1.005, False)])
def test_a_sampled_damper_is_stable_up_to_its_limit(
    delay_s: float, resolution_rad: float, limit: float, of_limit: float, stable: bool
) -> None:
    model = planar(1)
    device, clock = running(
        model,
        integrator="rk4",  # exact on a free bar; semi-implicit makes the difference exact too
        encoder_resolution_rad=resolution_rad,
        velocity_filter_s=0.0,
        torque_delay_s=delay_s,
    )
    M = model.terms(np.zeros(1), np.zeros(1)).M
    damping_nm_s = of_limit * limit / damping_ratio(0.001, M, np.eye(1))
    device.read()
    device.write(np.array([1e-6 * BAR_KG_M2 / 0.001]))  # a kick to 1e-6 rad/s
    speeds = []
    for _ in range(2000):
        clock.ns += MS
        velocity = device.read().velocity_rad_s
        device.write(-damping_nm_s * velocity)
        speeds.append(abs(velocity[0]))
    first, last = max(speeds[:20]), max(speeds[-20:])
    assert (last < 0.1 * first) if stable else (last > 10.0 * first)


# Lifecycle.


def test_brakes_hold_the_arm_while_outputs_are_off() -> None:
    device, clock = running(planar(2), constant(5.0, 5.0))
    moving = ticks(device, clock, 50)[-1]
    assert np.abs(moving[1]).max() > 0.1
    device.stop()
    held = ticks(device, clock, 50)
    np.testing.assert_array_equal(held[:, 0], np.broadcast_to(moving[0], (50, 2)))
    np.testing.assert_array_equal(held[:, 1], 0.0)
    assert device.read().wrench[0] == 5.0  # still felt


def test_without_brakes_the_arm_drifts_at_zero_torque() -> None:
    device, clock = running(planar(1), brakes=False)
    device.write(np.array([0.1]))
    velocity = ticks(device, clock, 50)[-1, 1, 0]
    device.stop()
    drift = ticks(device, clock, 50)[:, :, 0]
    np.testing.assert_array_equal(drift[:, 1], velocity)
    np.testing.assert_allclose(np.diff(drift[:, 0]), 0.001 * velocity)


def test_time_before_enable_is_not_lived_after_it() -> None:
    clock = Clock()
    device = SimulatedDevice(
        planar(1), SimulatedSettings((0.4,)), constant(0.0, 1.0), clock, 0, seed=0
    )
    device.open()
    clock.ns += 30 * MS
    device.enable()
    np.testing.assert_array_equal(device.read().position_rad, [0.4])
    assert device.skipped_ns == 0


def test_reopening_starts_afresh() -> None:
    device, clock = running(planar(2), constant(1.0, 2.0), velocity_noise_rad_s=0.1)
    first = ticks(device, clock, 20)
    device.close()
    device.open()
    device.enable()
    clock.ns += 0
    np.testing.assert_array_equal(ticks(device, clock, 20), first)


def test_opening_twice_is_an_error() -> None:
    device, _ = running(planar(1))
    with pytest.raises(DeviceError, match="already open"):
        device.open()


# Time.


@pytest.mark.parametrize(
    ("elapsed_ns", "steps"),
    [(0, 0), (1, 1), (MS, 1), (MS + 1, 2), (2 * MS, 2), (7 * MS, 7), (50 * MS, 50), (90 * MS, 50)],
)
@pytest.mark.parametrize("start_ns", [0, 3_141_592_653_589_793])
def test_one_clock_step_is_one_integration_step(elapsed_ns: int, steps: int, start_ns: int) -> None:
    contact = constant(0.0, 0.0)
    device, clock = running(planar(2), contact, start_ns=start_ns)
    clock.ns += elapsed_ns
    device.read()
    assert len(contact.asked) == steps + 1  # one more for the wrench


def test_semi_implicit_step_is_exactly_the_formula() -> None:
    model = planar(3, "point")
    device, clock = running(model)
    device.write(np.array([0.3, -0.1, 0.2]))
    q, q_dot = np.full(3, 0.4), np.zeros(3)
    for position, velocity in ticks(device, clock, 100):
        q_dot = q_dot + 0.001 * model.forward_dynamics(q, q_dot, np.array([0.3, -0.1, 0.2]))
        q = q + 0.001 * q_dot
        np.testing.assert_array_equal(position, q)
        np.testing.assert_array_equal(velocity, q_dot)


def test_a_long_wait_is_cut_and_counted() -> None:
    late, late_clock = running(planar(2), constant(1.0, 0.0))
    prompt, prompt_clock = running(planar(2), constant(1.0, 0.0))
    late_clock.ns += 1050 * MS
    np.testing.assert_array_equal(late.read().position_rad, ticks(prompt, prompt_clock, 50)[-1, 0])
    assert (late.skipped_ns, prompt.skipped_ns) == (1000 * MS, 0)
    late.stop()
    late_clock.ns += 1050 * MS
    late.read()
    assert late.skipped_ns == 1000 * MS  # braked time is not simulated, so none is lost


def test_a_contact_is_asked_anew_whenever_the_state_or_the_time_is_another() -> None:
    contact = Push(lambda t, X, X_dot: np.array([t, 0.0]) - X_dot)
    device, clock = running(planar(2), contact)
    moving = ticks(device, clock, 5)[-1]
    held_n = device.read().wrench[:2]
    assert len(contact.asked) == 6  # five steps, the first before any reading
    device.stop()  # the brakes change the velocity only
    braked_n = device.read().wrench[:2]
    assert len(contact.asked) == 7
    assert np.abs(moving[1]).max() > 0.0
    assert (braked_n != held_n).any()
    clock.ns += MS  # and only time passes
    assert device.read().wrench[0] == pytest.approx(0.006)
    assert len(contact.asked) == 8


@pytest.mark.parametrize("integrator", ["semi-implicit", "rk4"])
def test_reading_between_steps_changes_no_bit_of_the_motion(integrator: str) -> None:
    """The contact of a reading serves the step after it: as if it had been asked again."""
    read_often, often_clock = running(planar(2), Push(wall), integrator=integrator)
    read_once, once_clock = running(planar(2), Push(wall), integrator=integrator)
    ticks(read_often, often_clock, 50)
    ticks(read_once, once_clock, 1, 50 * MS)
    one, other = read_often.read(), read_once.read()
    np.testing.assert_array_equal(one.position_rad, other.position_rad)
    np.testing.assert_array_equal(one.velocity_rad_s, other.velocity_rad_s)


def test_contact_sees_session_time() -> None:
    contact = constant(0.0, 0.0)
    start_ns = 5_000_000_000_123
    device, clock = running(planar(2), contact, start_ns=start_ns)
    ticks(device, clock, 2, 2 * MS)
    times = [time_s for time_s, _, _ in contact.asked]
    assert times == pytest.approx([0.0, 0.001, 0.002, 0.003, 0.004], abs=1e-15)


def test_runs_repeat_bit_for_bit() -> None:
    def run(seed: int) -> FloatArray:
        device, clock = running(
            planar(3),
            Push(wall),
            seed=seed,
            coulomb_friction_nm=0.01,
            viscous_friction_nm_s=0.001,
            encoder_resolution_rad=1e-4,
            velocity_noise_rad_s=0.01,
        )
        rows = []
        for _ in range(300):
            clock.ns += MS
            state = device.read()
            device.write(-0.05 * state.velocity_rad_s)  # noise enters the motion
            rows.append(np.concatenate([state.position_rad, state.velocity_rad_s, state.wrench]))
        return np.array(rows)

    np.testing.assert_array_equal(run(7), run(7))
    assert (run(7) != run(8)).any()


def test_divergence_is_reported_and_the_last_sane_state_kept() -> None:
    device, clock = running(planar(2))
    device.write(np.array([1e9, 0.0]))
    clock.ns += 3 * MS
    with pytest.raises(DeviceError, match=r"diverged at 0\.000 s"):
        device.read()
    device.stop()
    np.testing.assert_array_equal(device.read().position_rad, [0.4, 0.4])


# Settings.


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"initial_position_rad": (math.nan,)}, "initial_position_rad"),
        ({"step_s": 0.0}, r"step_s is 0\.0"),
        ({"step_s": 0.1}, "step_s"),
        ({"coulomb_friction_nm": -1.0}, r"coulomb_friction_nm is -1\.0"),
        ({"torque_delay_s": -0.001}, r"torque_delay_s is -0\.001"),
        ({"torque_delay_s": math.inf}, "torque_delay_s"),
        ({"torque_delay_s": math.nan}, "torque_delay_s"),
        ({"velocity_noise_rad_s": math.inf}, "velocity_noise_rad_s"),
        ({"torque_limit_nm": 0.0}, "torque_limit_nm"),
        ({"torque_limit_nm": math.nan}, "torque_limit_nm"),
    ],
)
def test_impossible_settings_are_refused(change: dict[str, object], message: str) -> None:
    good: dict[str, object] = {"driver": "simulated", "initial_position_rad": (0.1,)}
    with pytest.raises(DeviceConfigurationError, match=message):
        SimulatedSettings(**(good | change))  # type: ignore[arg-type]
    # A schema validator tells the same story.
    with pytest.raises(ValidationError, match=message):
        TypeAdapter(SimulatedSettings).validate_python(good | change)


def test_the_initial_position_must_fit_the_robot() -> None:
    with pytest.raises(DeviceConfigurationError, match="has 3 angles, the robot has 2 joints"):
        SimulatedDevice(planar(2), SimulatedSettings((0.0,) * 3), None, Clock(), 0, seed=0)
