"""What every `Device` must do, whatever it drives; a new driver joins with one factory."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from hardware.interface import (
    Device,
    DeviceError,
    DeviceState,
    FloatArray,
    ForceReading,
    Mounting,
)
from hardware.phantom import PhantomDevice, PhantomSettings
from hardware.robot_model import PlanarArm, RobotModel, UrdfArm, build_robot
from hardware.sensed import SensedDevice
from hardware.serial_pair import SerialPair
from hardware.simulated import SimulatedDevice, SimulatedSettings
from tests.fakes.hd import fake_hd
from tests.fakes.hd.fake_hd import FakeHd
from tests.fakes.quanser_bench import QuanserBench

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@dataclass
class Bench:
    """A device nobody has opened, and a view of it from outside.

    `tick` lets about a millisecond pass; `motor_torque_nm` is what the actuators really receive;
    `torque_nm` is a small torque that the device accepts. Where the device has a vendor behind it,
    `unplug` and `garbage` take it away or make it talk nonsense, and `repair` undoes both. Stamps
    are on the clock `now_ns`.
    """

    device: Device
    tick: Callable[[], None]
    motor_torque_nm: Callable[[], FloatArray]
    torque_nm: FloatArray
    unplug: Callable[[], None] | None = None
    garbage: Callable[[], None] | None = None
    repair: Callable[[], None] | None = None
    now_ns: Callable[[], int] = time.monotonic_ns


class Wall:
    """A stiff wall, and a push towards it."""

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        force = np.full(len(position_m), 0.1)
        force[0] -= 300.0 * max(position_m[0] - 0.3, 0.0)
        return force


class Clock:
    ns = 12_345_678_901_234

    def __call__(self) -> int:
        return self.ns

    def tick(self) -> None:
        self.ns += 1_000_000


def simulated(model: RobotModel, settings: SimulatedSettings) -> Bench:
    clock = Clock()
    device = SimulatedDevice(model, settings, Wall(), clock, clock.ns, seed=1)
    return Bench(
        device=device,
        tick=clock.tick,
        motor_torque_nm=lambda: device._torque.copy(),
        torque_nm=np.linspace(0.01, 0.02, model.joints),
    )


def simulated_point_arm() -> Bench:
    model = build_robot(PlanarArm("planar", (0.38, 0.38), (0.3, 0.3), "point"), None)
    return simulated(model, SimulatedSettings((2.0, 1.5)))


def simulated_rod_arm_rk4() -> Bench:
    model = build_robot(PlanarArm("planar", (0.38,) * 3, (0.3,) * 3, "rod", (0.0, -9.81)), None)
    return simulated(model, SimulatedSettings((0.5, 0.5, -0.5), integrator="rk4"))


def simulated_seven_joints() -> Bench:
    model = build_robot(UrdfArm("urdf", "seven_dof_arm.urdf", "tool_tip"), EXPERIMENTS)
    return simulated(model, SimulatedSettings((0.0, 0.5, 0.0, 1.2, 0.0, 0.9, 0.0)))


def simulated_with_everything() -> Bench:
    model = build_robot(PlanarArm("planar", (0.21, 0.17), (0.2, 0.15), "rod"), None)
    settings = SimulatedSettings(
        (0.3, 1.2),
        encoder_resolution_rad=1.4e-4,
        coulomb_friction_nm=0.01,
        viscous_friction_nm_s=5e-4,
        torque_limit_nm=1.4,
        velocity_noise_rad_s=0.01,
        force_noise_n=0.05,
        brakes=False,
    )
    return simulated(model, settings)


class SteadyLoad:
    """A force sensor on the end effector that always feels the same."""

    mounting: Mounting = "end_effector"
    opened = False

    def open(self) -> None:
        assert not self.opened
        self.opened = True

    def read(self) -> ForceReading:
        return ForceReading(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]), 1, saturated=False)

    def tare(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.opened = False


def simulated_with_force_sensor() -> Bench:
    model = build_robot(PlanarArm("planar", (0.38, 0.38), (0.3, 0.3)), None)
    bench = simulated(model, SimulatedSettings((2.0, 1.5)))
    return replace(bench, device=SensedDevice(bench.device, SteadyLoad(), model))


def serial_pair() -> Bench:
    """Two simulated arms, each on its own base: the contract asks nothing of their dynamics."""
    model = build_robot(PlanarArm("planar", (0.21, 0.17), (0.2, 0.15), "rod"), None)
    near, far = (simulated(model, SimulatedSettings(start)) for start in ((0.3, 1.2), (1.2, 0.3)))

    def tick() -> None:
        near.tick()
        far.tick()

    return Bench(
        device=SerialPair(near.device, far.device, max_skew_s=0.005),
        tick=tick,
        motor_torque_nm=lambda: np.concatenate((near.motor_torque_nm(), far.motor_torque_nm())),
        torque_nm=np.linspace(0.01, 0.02, 4),
    )


def phantom() -> Bench:
    fake = FakeHd()
    settings = PhantomSettings(
        (0.1, -0.2),
        library=fake.library,
        device_name=fake.device_name,
        theta3="absolute",
        torque_ramp_s=0.0,
        timeout_s=0.5,
    )

    def motor_torque_nm() -> FloatArray:
        fake.frames(2)
        _, thigh_nm, shin_nm = fake.sent_nm
        return np.array([thigh_nm + shin_nm, shin_nm])

    def garbage() -> None:
        fake.block.value[1] = np.nan
        fake.block.replace[1] = 1

    def repair() -> None:
        fake.block.unplugged = fake.block.replace[1] = 0

    return Bench(
        device=PhantomDevice(settings),
        tick=lambda: fake.frames(2),
        motor_torque_nm=motor_torque_nm,
        torque_nm=np.array([0.01, 0.02]),
        unplug=lambda: setattr(fake.block, "unplugged", 1),
        garbage=garbage,
        repair=repair,
    )


def quanser() -> Bench:
    quanser = QuanserBench(joint_min_rad=(-1.0, -2.0), joint_max_rad=(1.5, 0.5))

    def unplug() -> None:
        quanser.board.unplug()
        quanser.wait(quanser.settings.watchdog_s)  # only the board itself can end torque now

    return Bench(
        device=quanser.device,
        tick=quanser.tick,
        motor_torque_nm=quanser.torque_nm,
        torque_nm=np.array([0.02, -0.01]),
        unplug=unplug,
        garbage=lambda: quanser.board.jump(0, 100_000),
        repair=quanser.board.plug,
        now_ns=quanser.time,
    )


SIMULATED: tuple[Callable[[], Bench], ...] = (
    simulated_point_arm,
    simulated_rod_arm_rk4,
    simulated_seven_joints,
    simulated_with_everything,
    serial_pair,
    simulated_with_force_sensor,
)
DRIVERS: tuple[Callable[[], Bench], ...] = (phantom, quanser)
FACTORIES = (*SIMULATED, *DRIVERS)


def built(factory: Callable[[], Bench]) -> Callable[[], Bench]:
    """Skip where the stand-in of a vendor's library cannot be built."""
    if factory is phantom and (reason := fake_hd.missing()):
        pytest.skip(reason)
    return factory


@pytest.fixture(params=FACTORIES, ids=lambda factory: factory.__name__)
def factory(request: pytest.FixtureRequest) -> Callable[[], Bench]:
    return built(request.param)


@pytest.fixture
def bench(factory: Callable[[], Bench]) -> Iterator[Bench]:
    bench = factory()
    yield bench
    bench.device.close()


@pytest.fixture(params=DRIVERS, ids=lambda factory: factory.__name__)
def vendors(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A running device with a vendor behind it."""
    bench = built(request.param)()
    bench.device.open()
    bench.device.enable()
    run(bench, 5)
    yield bench
    bench.device.close()


@pytest.fixture
def enabled(bench: Bench) -> Bench:
    bench.device.open()
    bench.device.read()
    bench.device.enable()
    return bench


def run(bench: Bench, ticks: int) -> list[DeviceState]:
    states = []
    for _ in range(ticks):
        bench.tick()
        states.append(bench.device.read())
        bench.device.write(bench.torque_nm)
    return states


# The steps that lead to each state of a device's lifecycle.
LIFECYCLE: dict[str, tuple[str, ...]] = {
    "new": (),
    "open": ("open",),
    "enabled": ("open", "enable"),
    "moving": ("open", "enable", "run"),
    "stopped": ("open", "enable", "run", "stop"),
    "closed": ("open", "enable", "run", "close"),
}


def bring_to(bench: Bench, stage: str) -> None:
    for step in LIFECYCLE[stage]:
        if step == "run":
            run(bench, 3)
        else:
            getattr(bench.device, step)()


def test_a_reading_is_finite_fresh_and_of_the_declared_shape(enabled: Bench) -> None:
    n = enabled.device.joints
    states = run(enabled, 20)
    for state in states:
        assert state.position_rad.shape == state.velocity_rad_s.shape == (n,)
        assert state.wrench.shape == (6,)
        for values in (state.position_rad, state.velocity_rad_s, state.wrench):
            assert values.dtype == np.float64
            assert np.isfinite(values).all()
        assert isinstance(state.stamp_ns, int)
    kept = states[-1].position_rad.copy(), states[-1].velocity_rad_s.copy()
    run(enabled, 5)
    np.testing.assert_array_equal(states[-1].position_rad, kept[0])
    np.testing.assert_array_equal(states[-1].velocity_rad_s, kept[1])


def test_stops_are_there_before_opening_and_stay(bench: Bench) -> None:
    before = bench.device.joint_stops
    count = len(before.matrix)
    assert before.matrix.shape == (count, bench.device.joints)
    assert before.lower_rad.shape == before.upper_rad.shape == (count,)
    assert np.isfinite(before.matrix).all()
    assert before.matrix.any(axis=1).all()
    assert (before.lower_rad < before.upper_rad).all()
    bring_to(bench, "moving")
    position_rad = before.matrix @ bench.device.read().position_rad
    assert ((before.lower_rad <= position_rad) & (position_rad <= before.upper_rad)).all()
    for _ in range(2):
        for name in ("matrix", "lower_rad", "upper_rad"):
            now = getattr(bench.device.joint_stops, name)
            np.testing.assert_array_equal(now, getattr(before, name))
        bench.device.close()


def test_units_are_radians_and_newtons(enabled: Bench) -> None:
    states = run(enabled, 100)
    positions = np.array([state.position_rad for state in states])
    velocities = np.array([state.velocity_rad_s for state in states])
    stamps_s = np.array([state.stamp_ns for state in states]) * 1e-9
    assert np.abs(positions).max() < 2.0 * np.pi
    assert max(np.abs(state.wrench).max() for state in states) < 1e3
    # The velocity is that of the position, per second: degrees or milliseconds would show.
    travelled = positions[-1] - positions[0]
    covered = (velocities[1:] * np.diff(stamps_s)[:, None]).sum(axis=0)
    np.testing.assert_allclose(covered, travelled, atol=0.1 * np.abs(travelled).max() + 2e-3)


def test_stamps_advance_with_time(enabled: Bench) -> None:
    stamps = np.array([state.stamp_ns for state in run(enabled, 50)])
    assert (np.diff(stamps) > 0).all()
    assert enabled.device.read().stamp_ns >= stamps[-1]


def test_written_torque_reaches_the_motors(enabled: Bench) -> None:
    run(enabled, 2)
    np.testing.assert_allclose(enabled.motor_torque_nm(), enabled.torque_nm, rtol=1e-3)


def test_writing_does_not_keep_the_callers_array(enabled: Bench) -> None:
    enabled.device.read()
    torque = enabled.torque_nm.copy()
    enabled.device.write(torque)
    torque[:] = np.nan
    enabled.tick()
    assert np.isfinite(enabled.device.read().position_rad).all()
    assert np.isfinite(enabled.motor_torque_nm()).all()


@pytest.mark.parametrize("stage", ["new", "open", "stopped", "closed"])
def test_torque_is_refused_while_the_outputs_are_off(bench: Bench, stage: str) -> None:
    bring_to(bench, stage)
    with pytest.raises(DeviceError, match="enable"):
        bench.device.write(bench.torque_nm)
    np.testing.assert_array_equal(bench.motor_torque_nm(), 0.0)


def test_torque_of_a_wrong_shape_is_refused(enabled: Bench) -> None:
    run(enabled, 2)
    before = enabled.motor_torque_nm()
    n = enabled.device.joints
    for shape in ((n + 1,), (n - 1,), (n, 1), ()):
        with pytest.raises(DeviceError, match="shape"):
            enabled.device.write(np.zeros(shape))
    np.testing.assert_array_equal(enabled.motor_torque_nm(), before)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_torque_that_is_not_finite_is_refused(enabled: Bench, value: float) -> None:
    run(enabled, 2)
    before = enabled.motor_torque_nm()
    for joint in range(enabled.device.joints):
        torque = enabled.torque_nm.copy()
        torque[joint] = value
        with pytest.raises(DeviceError, match="finite"):
            enabled.device.write(torque)
    np.testing.assert_array_equal(enabled.motor_torque_nm(), before)


@pytest.mark.parametrize("stage", sorted(LIFECYCLE))
def test_stop_is_always_allowed_and_may_be_repeated(bench: Bench, stage: str) -> None:
    bring_to(bench, stage)
    for _ in range(3):
        bench.device.stop()
        np.testing.assert_array_equal(bench.motor_torque_nm(), 0.0)


def test_no_torque_is_left_after_stop_nor_after_enabling_again(enabled: Bench) -> None:
    run(enabled, 5)
    assert enabled.motor_torque_nm().any()
    enabled.device.stop()
    np.testing.assert_array_equal(enabled.motor_torque_nm(), 0.0)
    enabled.tick()
    enabled.device.read()  # a stopped device can still be watched
    enabled.device.enable()
    np.testing.assert_array_equal(enabled.motor_torque_nm(), 0.0)
    assert len(run(enabled, 5)) == 5
    np.testing.assert_allclose(enabled.motor_torque_nm(), enabled.torque_nm, rtol=1e-3)


def test_enabling_starts_from_zero_torque(bench: Bench) -> None:
    bench.device.open()
    bench.device.enable()
    np.testing.assert_array_equal(bench.motor_torque_nm(), 0.0)
    run(bench, 3)
    bench.device.enable()  # again: harmless, and back at zero
    np.testing.assert_array_equal(bench.motor_torque_nm(), 0.0)


@pytest.mark.parametrize("stage", sorted(LIFECYCLE))
def test_close_is_always_allowed_and_may_be_repeated(bench: Bench, stage: str) -> None:
    bring_to(bench, stage)
    for _ in range(3):
        bench.device.close()
        np.testing.assert_array_equal(bench.motor_torque_nm(), 0.0)


@pytest.mark.parametrize("stage", ["new", "closed"])
def test_a_device_that_is_not_open_neither_reads_nor_enables(bench: Bench, stage: str) -> None:
    bring_to(bench, stage)
    with pytest.raises(DeviceError, match="open"):
        bench.device.read()
    with pytest.raises(DeviceError, match="open"):
        bench.device.enable()


def test_opening_an_open_device_is_refused(enabled: Bench) -> None:
    with pytest.raises(DeviceError, match="already open"):
        enabled.device.open()


def test_opening_and_closing_leaks_nothing(factory: Callable[[], Bench]) -> None:
    def one_round() -> None:
        bench = factory()
        for _ in range(5):
            bench.device.open()
            bench.device.enable()
            run(bench, 1)
            bench.device.close()

    one_round()  # what is loaded once is no leak
    threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        one_round()
    assert threading.active_count() == threads
    assert len(os.listdir("/proc/self/fd")) == files


@pytest.mark.parametrize("trouble", ["unplug", "garbage"])
def test_a_fault_zeroes_the_torque_and_stays_until_the_device_is_opened_again(
    vendors: Bench, trouble: str
) -> None:
    assert vendors.repair is not None
    assert vendors.motor_torque_nm().any()
    getattr(vendors, trouble)()
    with pytest.raises(DeviceError) as first:
        run(vendors, 1000)
    np.testing.assert_array_equal(vendors.motor_torque_nm(), 0.0)
    vendors.repair()
    for _ in range(2):
        for call in (
            vendors.device.read,
            vendors.device.enable,
            lambda: vendors.device.write(vendors.torque_nm),
        ):
            with pytest.raises(DeviceError) as again:
                call()
            assert str(again.value) == str(first.value)
        vendors.tick()
        np.testing.assert_array_equal(vendors.motor_torque_nm(), 0.0)
        vendors.device.stop()
    vendors.device.close()
    vendors.device.open()
    vendors.device.enable()
    np.testing.assert_array_equal(vendors.motor_torque_nm(), 0.0)
    run(vendors, 5)
    np.testing.assert_allclose(vendors.motor_torque_nm(), vendors.torque_nm, rtol=1e-3)


def test_stamps_tell_when_the_state_was_taken(vendors: Bench) -> None:
    before_ns = vendors.now_ns()
    vendors.tick()
    vendors.tick()
    stamp_ns = vendors.device.read().stamp_ns
    assert before_ns < stamp_ns <= vendors.now_ns()
