"""A device whose wrench is measured by a force sensor."""

import numpy as np

from hardware.interface import Device, DeviceError, DeviceState, FloatArray, ForceSensor, JointStops
from hardware.robot_model import RobotModel


class SensedDevice:
    """A `Device` that joins a device's motion with a sensor's wrench, in base axes.

    `stamp_ns` of a reading is the motion's. A failed or stale sensor is a fault of the device: it
    is stopped, and stays so until `close` and `open`. A saturated reading is no fault; it is
    counted in `saturated_readings`.
    """

    def __init__(self, device: Device, sensor: ForceSensor, model: RobotModel) -> None:
        self.saturated_readings = 0
        self._device = device
        self._sensor = sensor
        self._model = model
        self._turns = sensor.mounting == "end_effector"
        self._opened = False
        self._fault: str | None = None

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self._device.joints

    @property
    def joint_stops(self) -> JointStops:
        """Those of the device."""
        return self._device.joint_stops

    def open(self) -> None:
        """Open the sensor, which tares it, and the device; both or none."""
        if self._opened:
            raise DeviceError("the device is already open; close it first")
        self._sensor.open()
        try:
            self._device.open()
        except BaseException:
            self._sensor.close()
            raise
        self._fault = None
        self.saturated_readings = 0
        self._opened = True

    def enable(self) -> None:
        """Switch the outputs on; refused without a fresh reading of the sensor."""
        self._require_no_fault()
        if self._opened:
            self._read_wrench()
        self._device.enable()

    def read(self) -> DeviceState:
        """Return the newest motion and wrench."""
        self._require_no_fault()
        state = self._device.read()
        wrench = self._read_wrench()
        if self._turns:
            R = self._model.orientation(state.position_rad)
            wrench = np.concatenate((R @ wrench[:3], R @ wrench[3:]))
        return state._replace(wrench=wrench)

    def write(self, torque_nm: FloatArray) -> None:
        """Command joint torques (n,) [N·m]."""
        self._require_no_fault()
        self._device.write(torque_nm)

    def stop(self) -> None:
        """Zero the torque, outputs off."""
        self._device.stop()

    def close(self) -> None:
        """Stop and disconnect both."""
        try:
            self._device.close()
        finally:
            self._sensor.close()
            self._opened = False

    def _read_wrench(self) -> FloatArray:
        try:
            reading = self._sensor.read()
        except DeviceError as error:
            self._fault = str(error)
            self._device.stop()
            raise
        self.saturated_readings += reading.saturated
        return reading.wrench

    def _require_no_fault(self) -> None:
        if self._fault is not None:
            raise DeviceError(f"stopped by its force sensor: {self._fault}; close it and open it")
