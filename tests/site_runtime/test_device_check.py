"""Readings with torque off, and small torques that no bad answer gets past."""

from collections.abc import Callable
from math import inf

import numpy as np
import pytest

from hardware.interface import DeviceError, DeviceState, FloatArray, JointStops
from hardware.robot_model import PlanarArm, RobotModel, build_robot
from hardware.simulated import SimulatedDevice, SimulatedSettings
from site_runtime.clock import ManualClock
from site_runtime.device_check import STILL_RAD, Answer, Interrupted, Push, TorqueTest, watch
from site_runtime.guard import Guard, Limits

PERIOD_NS = 1_000_000
TORQUE_NM = np.array([0.05, 0.02])
MOTION_RAD = 0.05
ROBOT = build_robot(PlanarArm("planar", (0.21, 0.17), (0.2, 0.15)), None)


class Wired:
    """The simulated arm as a bench may wrongly wire it; keeps every torque asked of it."""

    def __init__(self, model: RobotModel, clock: ManualClock, **imperfections: float) -> None:
        settings = SimulatedSettings((0.3, 1.2), **imperfections)  # type: ignore[arg-type]
        self.arm = SimulatedDevice(model, settings, None, clock.now_ns, 0, seed=1)
        self.joints = 2
        self.signs = np.ones(2)
        self.torques_nm: list[FloatArray] = []
        self.enabled = False
        self.reads_left = inf
        self.stops = 0
        self.open, self.close = self.arm.open, self.arm.close

    def enable(self) -> None:
        self.enabled = True
        self.arm.enable()

    def read(self) -> DeviceState:
        self.reads_left -= 1
        if self.reads_left < 0:
            raise DeviceError("unplugged")
        return self.arm.read()

    def write(self, torque_nm: FloatArray) -> None:
        self.torques_nm.append(torque_nm.copy())
        self.arm.write(self.signs * torque_nm)

    def stop(self) -> None:
        self.enabled = False
        self.stops += 1
        self.arm.stop()


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def make(clock: ManualClock) -> Callable[..., tuple[Wired, TorqueTest]]:
    def make(
        torque_limit_nm: float = inf,
        should_stop: Callable[[], bool] = lambda: False,
        **imperfections: float,
    ) -> tuple[Wired, TorqueTest]:
        device = Wired(ROBOT, clock, **imperfections)
        device.open()
        box = np.full(2, inf)
        limits = Limits(
            torque_nm=np.full(2, torque_limit_nm),
            torque_rate_nm_s=np.full(2, inf),
            velocity_rad_s=np.full(2, inf),
            kinetic_energy_j=inf,
            workspace_min_m=-box,
            workspace_max_m=box,
            stops=JointStops.none(2),
            fault_after_s=inf,
        )
        test = TorqueTest(
            device,
            ROBOT,
            Guard(limits, PERIOD_NS * 1e-9),
            clock,
            PERIOD_NS,
            torque_nm=TORQUE_NM,
            motion_rad=MOTION_RAD,
            should_stop=should_stop,
        )
        return device, test

    return make


Make = Callable[..., tuple[Wired, TorqueTest]]


def told(pushes: list[Push]) -> list[tuple[int, float, Answer]]:
    return [(push.joint, push.torque_nm, push.answer) for push in pushes]


def test_a_sound_arm_follows_each_push_and_stays_near(make: Make) -> None:
    device, test = make()
    pushes = test.run()
    assert told(pushes) == [
        (0, 0.05, Answer.FOLLOWED),
        (0, -0.05, Answer.FOLLOWED),
        (1, 0.02, Answer.FOLLOWED),
        (1, -0.02, Answer.FOLLOWED),
    ]
    for push in pushes:
        assert STILL_RAD < abs(push.travel_rad[push.joint]) < 2.0 * MOTION_RAD
    assert not device.enabled


def test_torques_are_small_smooth_and_end_at_zero(make: Make) -> None:
    device, test = make()
    test.run()
    torques_nm = np.array(device.torques_nm)
    assert (np.abs(torques_nm) <= TORQUE_NM).all()
    assert (np.abs(torques_nm).max(axis=0) > 0.5 * TORQUE_NM).all()
    # ramped in: 0.25 s of a quintic rise by at most 1.875/0.25 of the torque a second
    pushing = torques_nm[1000:1100]
    assert np.abs(np.diff(pushing, axis=0)).max() < 2.0 * 1.875 / 0.25 * 1e-3 * 0.05
    assert not torques_nm[:1000].any()
    np.testing.assert_allclose(torques_nm[-1], 0.0, atol=1e-6)


def test_friction_that_holds_a_joint_is_told(make: Make) -> None:
    _, test = make(coulomb_friction_nm=0.06)
    assert [push.answer for push in test.run()] == [Answer.STILL] * 4


def test_the_guard_cuts_what_is_too_much(make: Make) -> None:
    device, test = make(torque_limit_nm=0.01)
    test.run()
    assert np.abs(device.torques_nm).max() == 0.01


@pytest.mark.parametrize("joint", [0, 1])
def test_a_wrong_sign_is_stopped_before_the_arm_is_far(
    make: Make, clock: ManualClock, joint: int
) -> None:
    device, test = make()
    device.signs[joint] = -1.0
    pushes = test.run()
    assert pushes[-1].joint <= joint
    assert pushes[-1].answer in (Answer.AGAINST, Answer.RAN_AWAY)
    assert not device.enabled
    assert np.abs(device.arm.read().position_rad - [0.3, 1.2]).max() < 5.0 * MOTION_RAD


def test_an_arm_that_somebody_moves_is_let_go(make: Make, clock: ManualClock) -> None:
    class Hand:
        def force_n(self, time_s: float, x_m: FloatArray, v_m_s: FloatArray) -> FloatArray:
            return np.array([0.5, 0.5])

    device, test = make()
    device.arm._contact = Hand()
    pushes = test.run()
    assert told(pushes) == [(0, 0.0, Answer.RAN_AWAY)]
    assert not device.enabled


def test_an_unplugged_arm_is_stopped(make: Make) -> None:
    device, test = make()
    device.reads_left = 1500
    with pytest.raises(DeviceError, match="unplugged"):
        test.run()
    assert not device.enabled


def test_being_told_to_stop_ends_it(make: Make) -> None:
    polls = iter(range(10_000))
    device, test = make(should_stop=lambda: next(polls) > 1500)
    with pytest.raises(Interrupted):
        test.run()
    assert not device.enabled
    assert len(device.torques_nm) > 1000


def test_readings_are_told_as_they_were(clock: ManualClock) -> None:
    class Noisy:
        """New data at every second reading, 3 ms old."""

        joints = 2

        def __init__(self) -> None:
            self.reads = 0
            self.random = np.random.default_rng(1)

        def read(self) -> DeviceState:
            self.reads += 1
            noise = self.random.standard_normal(2)
            return DeviceState(
                [0.5, -0.5] + 1e-3 * noise,
                [0.0, 0.0] + 1e-1 * noise,
                np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]),
                (clock.now_ns() // (2 * PERIOD_NS)) * 2 * PERIOD_NS - 3_000_000,
            )

    device = Noisy()
    readings = watch(device, clock, PERIOD_NS, 2.0, lambda: False)  # type: ignore[arg-type]
    assert device.reads == 2000
    assert readings.rate_hz == pytest.approx(1000.0)
    assert readings.fresh_hz == pytest.approx(500.0, abs=1.0)
    np.testing.assert_allclose(readings.position_rad, [0.5, -0.5], atol=1e-4)
    np.testing.assert_allclose(readings.position_noise_rad, 1e-3, rtol=0.1)
    np.testing.assert_allclose(readings.velocity_noise_rad_s, 1e-1, rtol=0.1)
    np.testing.assert_allclose(readings.wrench, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    assert not readings.wrench_noise.any()
    np.testing.assert_allclose(readings.age_s, [3.5e-3, 4e-3, 4e-3], atol=5.1e-4)
    with pytest.raises(Interrupted):
        watch(device, clock, PERIOD_NS, 2.0, lambda: True)  # type: ignore[arg-type]
