"""A PHANToM Premium 1.5 as a planar arm of two joints, through OpenHaptics."""

import math
import os
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hardware.hdapi import HdapiError, load_hdapi
from hardware.interface import (
    DeviceConfigurationError,
    DeviceError,
    DeviceState,
    FloatArray,
    JointStops,
)
from hardware.phantom_kinematics import Parallelogram, ThirdAngleCheck
from hardware.phantom_process import ServoProcess
from hardware.phantom_servo import FAULT, ServoOptions
from hardware.registry import DeviceContext, DriverEntry

PEAK_TORQUE_NM = 1.445
USUAL_LIBRARY = "libHD.so"
_ACKNOWLEDGE_S = 0.5

CALIBRATION_POSE = (
    "hold the arm so that all its links are at right angles (thigh horizontal, shin straight down)"
)


@dataclass(frozen=True, slots=True)
class PhantomSettings:
    """Settings of the driver "phantom".

    `joint_offset_rad`, β1 and β2, relate the device's zero to the robot's; `motor_torque_limit_nm`
    holds for thigh and shin. `timeout_s` is the longest silence between site and servo, either
    way, that is not a fault. Velocity is the difference of positions through a first-order filter
    of time constant `difference_filter_s`. `clutch_button` says that the device has buttons: any of
    them, held down, is the clutch. One without a stylus may read noise there.
    """

    joint_offset_rad: tuple[float, float]
    driver: Literal["phantom"] = "phantom"
    library: str = USUAL_LIBRARY
    device_name: str = "Default PHANToM"
    theta3: Literal["check", "absolute", "relative"] = "check"
    calibrate_on_open: bool = False
    motor_torque_limit_nm: tuple[float, float] = (0.32, 0.32)
    torque_ramp_s: float = 0.5
    timeout_s: float = 0.01
    difference_filter_s: float = 0.0038
    clutch_button: bool = False

    def __post_init__(self) -> None:
        if not all(math.isfinite(angle) for angle in self.joint_offset_rad):
            raise DeviceConfigurationError(
                f"joint_offset_rad is {self.joint_offset_rad}; both angles must be finite"
            )
        if not all(0.0 < limit <= PEAK_TORQUE_NM for limit in self.motor_torque_limit_nm):
            raise DeviceConfigurationError(
                f"motor_torque_limit_nm is {self.motor_torque_limit_nm}; both must be above 0 and "
                f"at most {PEAK_TORQUE_NM} N·m, the motors' peak"
            )
        for name, low, high in (
            ("torque_ramp_s", 0.0, 60.0),
            ("timeout_s", 0.002, 1.0),
            ("difference_filter_s", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise DeviceConfigurationError(
                    f"{name} is {value}; choose between {low:g} and {high:g} s"
                )


class PhantomDevice:
    """A PHANToM whose base joint is fixed or removed; a `Device`.

    The vendor's servo loop runs in a process of its own. A fault of the device, of that process or
    of the timing between it and the site zeroes the torque and stays until `close` and `open`.
    """

    def __init__(self, settings: PhantomSettings) -> None:
        self._settings = settings
        self._timeout_ns = round(settings.timeout_s * 1e9)
        self._servo: ServoProcess | None = None
        self._fault: str | None = None
        self._enabling = 0
        self._enabled_ns: int | None = None
        self._resets = 0
        self._check = ThirdAngleCheck()
        self._last_ns = 0
        self._last_rad: FloatArray | None = None
        self._velocity_rad_s = np.zeros(2)
        self._take_third_angle()

    @property
    def joints(self) -> int:
        """Two: thigh and shin."""
        return 2

    @property
    def joint_stops(self) -> JointStops:
        """The mechanism's own, whichever way the third angle is given."""
        return self._arm.stops

    def open(self) -> None:
        """Start the servo process and take the device, outputs off."""
        if self._servo is not None:
            raise DeviceError("the PHANToM is already open; close it first")
        settings = self._settings
        self._servo = ServoProcess(
            ServoOptions(
                settings.library,
                settings.device_name,
                settings.motor_torque_limit_nm,
                settings.timeout_s,
                settings.clutch_button,
                _above(os.sched_getparam(0).sched_priority),
            )
        )
        self._fault = None
        self._enabling = self._resets = 0
        self._check = ThirdAngleCheck(None if settings.theta3 == "check" else settings.theta3)
        self._take_third_angle()
        if settings.calibrate_on_open:
            try:
                self.calibrate()
            except DeviceError:
                self.close()
                raise

    def calibrate(self) -> None:
        """Take the present pose, all links at right angles, as zero; outputs must be off."""
        servo = self._sound()
        if self._enabled_ns is not None:
            raise DeviceError(
                f"no calibration while the outputs are on: stop(), {CALIBRATION_POSE}, then again"
            )
        self._resets += 1
        self._check.restart()
        self._command()
        if not servo.wait(
            lambda: servo.memory.state.get()[2] == self._resets or servo.memory.phase == FAULT,
            _ACKNOWLEDGE_S,
        ):
            raise self._failed("the servo process does not answer")
        self._sound()
        self._last_rad = None

    def enable(self) -> None:
        """Switch force output on, at zero torque."""
        servo = self._sound()
        if not servo.memory.state.get()[3]:
            raise DeviceError(
                f"the PHANToM is not calibrated: {CALIBRATION_POSE} and calibrate it "
                "(or open it so, with calibrate_on_open = true)"
            )
        if self._check.found is None:
            raise DeviceError(self._check.open_question)
        self._enabling += 1
        self._enabled_ns = time.monotonic_ns()
        self._command(outputs=self._enabling)
        if not servo.wait(
            lambda: self._in_force() == self._enabling or servo.memory.phase == FAULT,
            _ACKNOWLEDGE_S,
        ):
            raise self._failed("the servo process does not answer")
        self._sound()
        self._enabled_ns = time.monotonic_ns()

    def read(self) -> DeviceState:
        """Return the newest state of the servo loop; the wrench is not measured and is zero."""
        servo = self._sound()
        stamp_ns, _, resets, _, buttons, *values = servo.memory.state.get()
        age_ns = time.monotonic_ns() - stamp_ns
        if age_ns > self._timeout_ns:
            raise self._failed(
                f"the newest reading is {age_ns * 1e-6:.1f} ms old"
                + ("" if servo.alive else "; its servo process has ended")
            )
        if self._check.found is None and resets == self._resets:
            self._check.add(tuple(values[:3]), tuple(values[3:]))
            if self._check.found is not None:
                self._take_third_angle()
        position_rad = self._arm.serial_rad(values[1], values[2])
        self._difference(position_rad, stamp_ns)
        velocity_rad_s = self._velocity_rad_s.copy()
        return DeviceState(position_rad, velocity_rad_s, np.zeros(6), stamp_ns, clutch=buttons != 0)

    def write(self, torque_nm: FloatArray) -> None:
        """Hand joint torques (2,) [N·m] to the servo loop, cut to the motors' limits there."""
        if self._enabled_ns is None and self._fault is None:
            raise DeviceError("torque refused: the outputs are off; call enable() first")
        self._sound()
        if torque_nm.shape != (2,):
            raise DeviceError(f"torque refused: shape {torque_nm.shape}, not (2,)")
        if not np.isfinite(torque_nm).all():
            raise DeviceError(f"torque refused: {torque_nm} N·m is not finite")
        now_ns = time.monotonic_ns()
        ramp_s = self._settings.torque_ramp_s
        since_s = (now_ns - (self._enabled_ns or now_ns)) * 1e-9
        share = 1.0 if since_s >= ramp_s else since_s / ramp_s
        thigh_nm, shin_nm = self._arm.device_nm(torque_nm)
        self._command(now_ns, self._enabling, share * thigh_nm, share * shin_nm)

    def stop(self) -> None:
        """Zero the torque and switch force output off; return when it has been done."""
        servo = self._servo
        if servo is None:
            return
        self._enabled_ns = None
        self._command()
        if not servo.wait(lambda: self._in_force() == 0 or not servo.alive, _ACKNOWLEDGE_S):
            self._failed("the servo process did not confirm the stop")

    def close(self) -> None:
        """Stop, let go of the device and end the servo process."""
        if self._servo is None:
            return
        self.stop()
        self._servo.end()
        self._servo = None
        self._fault = None

    def _sound(self) -> ServoProcess:
        """Return the servo process; raise if the device is closed or has failed."""
        if self._servo is None:
            raise DeviceError("the PHANToM is not open; call open() first")
        if self._fault is not None:
            raise self._failed(self._fault)
        if self._servo.memory.phase == FAULT:
            raise self._failed(self._servo.memory.text)
        return self._servo

    def _failed(self, cause: str) -> DeviceError:
        """Latch the first cause, command outputs off, and return the error to raise."""
        if self._fault is None:
            self._fault = cause
        self._enabled_ns = None
        self._command()
        return DeviceError(f"the PHANToM has failed: {self._fault}; close and open it again")

    def _command(
        self, stamp_ns: int = 0, outputs: int = 0, thigh_nm: float = 0.0, shin_nm: float = 0.0
    ) -> None:
        if self._servo is not None:
            self._servo.memory.command.put(stamp_ns, outputs, self._resets, thigh_nm, shin_nm)

    def _in_force(self) -> int:
        """Return the number of the enabling that the servo loop follows, 0 for outputs off."""
        return 0 if self._servo is None else int(self._servo.memory.state.get()[1])

    def _take_third_angle(self) -> None:
        """Read the angles as found, as absolute before; the velocity starts anew."""
        self._arm = Parallelogram(self._settings.joint_offset_rad, self._check.found or "absolute")
        self._last_rad = None

    def _difference(self, position_rad: FloatArray, stamp_ns: int) -> None:
        if self._last_rad is None:
            self._velocity_rad_s = np.zeros(2)
        elif stamp_ns > self._last_ns:
            elapsed_s = (stamp_ns - self._last_ns) * 1e-9
            weight = elapsed_s / (elapsed_s + self._settings.difference_filter_s)
            difference = (position_rad - self._last_rad) / elapsed_s
            self._velocity_rad_s += weight * (difference - self._velocity_rad_s)
        else:
            return
        self._last_rad, self._last_ns = position_rad.copy(), stamp_ns


def _above(priority: int) -> int:
    """Return the servo's priority for the site's: its frames are short and must not wait."""
    return min(priority + 1, os.sched_get_priority_max(os.SCHED_FIFO)) if priority > 0 else 0


def _create(settings: PhantomSettings, context: DeviceContext) -> PhantomDevice:
    return PhantomDevice(settings)


def _missing(settings: PhantomSettings | None) -> str | None:
    try:
        load_hdapi(USUAL_LIBRARY if settings is None else settings.library)
    except HdapiError as error:
        return str(error)
    return None


DRIVER = DriverEntry(settings=PhantomSettings, create=_create, missing=_missing)
