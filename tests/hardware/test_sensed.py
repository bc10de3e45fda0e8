"""A device with a force sensor: one reading, one fault."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hardware.interface import DeviceError, FloatArray, ForceReading, Mounting
from hardware.robot_model import PlanarArm, UrdfArm, build_robot
from hardware.sensed import SensedDevice
from hardware.simulated import SimulatedDevice, SimulatedSettings

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
WRENCH = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


class Sensor:
    """A force sensor that does as it is told."""

    def __init__(self, mounting: Mounting = "base") -> None:
        self._mounting: Mounting = mounting
        self.wrench = WRENCH.copy()
        self.saturated = False
        self.failure: Exception | None = None
        self.opened = False
        self.stamp_ns = 7

    @property
    def mounting(self) -> Mounting:
        return self._mounting

    def open(self) -> None:
        if self.failure is not None:
            raise self.failure
        assert not self.opened
        self.opened = True

    def read(self) -> ForceReading:
        if self.failure is not None:
            raise self.failure
        return ForceReading(self.wrench, self.stamp_ns, self.saturated)

    def tare(self) -> None:
        pass

    def close(self) -> None:
        self.opened = False


class Clock:
    ns = 1_000_000_000

    def __call__(self) -> int:
        return self.ns


class Arm(SimulatedDevice):
    """Refuses to open when told."""

    stuck = False

    def open(self) -> None:
        if self.stuck:
            raise DeviceError("the arm is stuck")
        super().open()

    def motor_torque_nm(self) -> FloatArray:
        return self._torque


class Push:
    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        return np.array([9.0, 9.0])


Q = (0.3, 1.1)


def built(mounting: Mounting = "base") -> tuple[SensedDevice, Arm, Sensor]:
    model = build_robot(PlanarArm("planar", (0.38, 0.38), (0.3, 0.3)), None)
    sensor = Sensor(mounting)
    arm = Arm(model, SimulatedSettings(Q), Push(), Clock(), 0, 1)
    return SensedDevice(arm, sensor, model), arm, sensor


def test_the_sensor_s_wrench_replaces_the_device_s_and_the_motion_stays() -> None:
    device, arm, _ = built()
    device.open()
    state, own = device.read(), arm.read()
    np.testing.assert_array_equal(state.wrench, WRENCH)
    np.testing.assert_array_equal(own.wrench, [9.0, 9.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(state.position_rad, own.position_rad)
    np.testing.assert_array_equal(state.velocity_rad_s, own.velocity_rad_s)
    assert state.stamp_ns == own.stamp_ns
    assert device.joints == 2


def test_a_sensor_on_the_end_effector_is_turned_into_base_axes() -> None:
    device, _, _ = built("end_effector")
    device.open()
    c, s = math.cos(sum(Q)), math.sin(sum(Q))
    np.testing.assert_allclose(
        device.read().wrench,
        [c * 1.0 - s * 2.0, s * 1.0 + c * 2.0, 3.0, c * 0.1 - s * 0.2, s * 0.1 + c * 0.2, 0.3],
    )


def test_a_sensor_on_a_spatial_arm_follows_its_frame() -> None:
    model = build_robot(UrdfArm("urdf", "seven_dof_arm.urdf", "tool_tip"), EXPERIMENTS)
    q = (0.4, 0.5, -0.3, 1.2, 0.7, 0.9, -0.2)
    arm = SimulatedDevice(model, SimulatedSettings(q), None, Clock(), 0, 1)
    device = SensedDevice(arm, Sensor("end_effector"), model)
    device.open()
    wrench = device.read().wrench
    R = model.orientation(np.array(q))
    np.testing.assert_allclose(R.T @ wrench[:3], WRENCH[:3])
    np.testing.assert_allclose(R.T @ wrench[3:], WRENCH[3:])
    assert np.abs(wrench - WRENCH).max() > 0.5


def write(device: SensedDevice) -> None:
    device.write(np.array([0.01, 0.02]))


def test_a_failed_sensor_stops_the_device_and_keeps_it_stopped() -> None:
    device, arm, sensor = built()
    device.open()
    device.read()
    device.enable()
    write(device)
    assert arm.motor_torque_nm().any()
    sensor.failure = DeviceError("no new force for 0.02 s")
    with pytest.raises(DeviceError, match="no new force"):
        device.read()
    assert not arm.motor_torque_nm().any()
    with pytest.raises(DeviceError, match="outputs are off"):
        arm.write(np.zeros(2))
    sensor.failure = None
    calls: tuple[Callable[[], object], ...] = (device.read, device.enable, lambda: write(device))
    for call in calls:
        with pytest.raises(DeviceError, match=r"stopped by its force sensor: no new force.*open"):
            call()
    device.stop()
    device.close()
    device.open()
    device.read()
    device.enable()
    write(device)


def test_outputs_stay_off_while_the_sensor_fails() -> None:
    device, arm, sensor = built()
    device.open()
    sensor.failure = DeviceError("no new force")
    with pytest.raises(DeviceError, match="no new force"):
        device.enable()
    with pytest.raises(DeviceError, match="outputs are off"):
        arm.write(np.zeros(2))


def test_saturation_is_counted_and_no_fault() -> None:
    device, _, sensor = built()
    device.open()
    device.read()
    sensor.saturated = True
    device.read()
    device.read()
    sensor.saturated = False
    device.read()
    assert device.saturated_readings == 2
    device.close()
    device.open()
    assert device.saturated_readings == 0


def test_both_open_or_none() -> None:
    device, arm, sensor = built()
    sensor.failure = DeviceError("no board")
    with pytest.raises(DeviceError, match="no board"):
        device.open()
    with pytest.raises(DeviceError, match="not open"):
        arm.read()
    sensor.failure = None
    arm.stuck = True
    with pytest.raises(DeviceError, match="stuck"):
        device.open()
    assert not sensor.opened
    arm.stuck = False
    device.open()
    assert sensor.opened
    with pytest.raises(DeviceError, match="already open"):
        device.open()
    assert sensor.opened
    device.close()
    assert not sensor.opened


def test_the_sensor_is_closed_even_if_the_device_does_not_close(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    device, arm, sensor = built()
    device.open()

    def broken() -> None:
        raise DeviceError("will not close")

    monkeypatch.setattr(arm, "close", broken)
    with pytest.raises(DeviceError, match="will not close"):
        device.close()
    assert not sensor.opened
