"""What every device is to the rest of farhand: its state, its lifecycle, its errors.

Errors::

    HardwareError
    ├── DeviceError                 at run time: stop, and look at the machine
    └── DeviceConfigurationError    before anything moves: session file or installation is wrong
"""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class HardwareError(Exception):
    """Anything this package raises on purpose."""


class DeviceError(HardwareError):
    """A device failed, or was used out of order, at run time."""


class DeviceConfigurationError(HardwareError, ValueError):
    """Settings, a robot description or an installation that cannot work.

    Also a `ValueError`, so that a schema validator reports it with the place in the file.
    """


def nearest_names(name: str, valid: Iterable[str]) -> str:
    """Return the valid names closest to a mistyped one, or all of them, for an error message."""
    names = sorted(set(valid))
    return ", ".join(difflib.get_close_matches(name, names, n=5, cutoff=0.5) or names)


class DeviceState(NamedTuple):
    """One reading of a device.

    `wrench` (6,) [N, N·m] is what the hand or the environment exerts ON the robot at the end
    effector, in base axes; `stamp_ns` is on the site's monotonic clock. `clutch` says that the
    device's own button, if it has one, is held down.
    """

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    wrench: FloatArray
    stamp_ns: int
    clutch: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class JointStops:
    """Where a robot's joints end: lower ≤ A q ≤ upper, `matrix` A (m, n), bounds (m,) [rad].

    A row with one entry is a joint's own stop; one with more, a stop that couples joints.
    """

    matrix: FloatArray
    lower_rad: FloatArray
    upper_rad: FloatArray

    @classmethod
    def none(cls, joints: int) -> "JointStops":
        """Return no stops at all."""
        return cls(np.zeros((0, joints)), np.zeros(0), np.zeros(0))


class Device(Protocol):
    """A robot with torque-controlled joints: open → read* → enable → (read, write)* → stop → close.

    `stop` leads back to the state after `open`, so `enable` may follow; a closed device may be
    opened again. `read` and `write` are real-time safe; the others may block.
    """

    @property
    def joints(self) -> int:
        """Number of joints."""
        ...

    @property
    def joint_stops(self) -> JointStops:
        """Where the joints end, as far as the driver knows; the same from creation on."""
        ...

    def open(self) -> None:
        """Connect, outputs off; raises DeviceError, also when the device is already open."""
        ...

    def enable(self) -> None:
        """Switch the outputs on at zero torque, also when they are on; raises DeviceError."""
        ...

    def read(self) -> DeviceState:
        """Return the newest state; real-time safe; raises DeviceError."""
        ...

    def write(self, torque_nm: FloatArray) -> None:
        """Command joint torques (n,) [N·m]; real-time safe.

        Raises DeviceError, leaving the previous command, when the outputs are off, the shape is
        wrong or a value is not finite.
        """
        ...

    def stop(self) -> None:
        """Zero the torque, outputs off; never raises, idempotent, valid at any time."""
        ...

    def close(self) -> None:
        """Stop, then disconnect; idempotent."""
        ...


Mounting = Literal["base", "end_effector"]
"""The axes of a force sensor's readings: the robot's base, or the frame of its end effector."""


@dataclass(frozen=True, slots=True)
class ForceReading:
    """One reading of a force sensor.

    `wrench` (6,) [N, N·m] is what the hand or the environment exerts ON the robot, in the axes
    that `ForceSensor.mounting` names; the moment is about the sensor's origin. `stamp_ns` is when
    it arrived, on the site's monotonic clock. A `saturated` wrench is a lower bound, not a value.
    """

    wrench: FloatArray
    stamp_ns: int
    saturated: bool


class ForceSensor(Protocol):
    """A six-axis force sensor: open → (read | tare)* → close; a closed one may be opened again.

    Whatever fails on the sensor's side latches: from then on every call but `close` raises
    DeviceError with the first cause, until the sensor is closed and opened again.
    """

    @property
    def mounting(self) -> Mounting:
        """The axes of the readings."""
        ...

    def open(self) -> None:
        """Connect and tare, with nothing touching the robot; may block; raises DeviceError."""
        ...

    def read(self) -> ForceReading:
        """Return the newest reading; never blocks; raises DeviceError, also when it is stale."""
        ...

    def tare(self) -> None:
        """Make the present load the zero; may block; raises DeviceError."""
        ...

    def close(self) -> None:
        """Disconnect; never raises, idempotent."""
        ...


class ContactForce(Protocol):
    """Force of an operator or an environment on the end effector of a simulated device."""

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        """Return the force (z,) [N] on the robot at session time `time_s`, in base axes.

        Must depend on its arguments only: an integrator calls it several times a step.
        """
        ...


@runtime_checkable
class VelocityByDifference(Protocol):
    """Settings of a driver that may difference its positions, rather than measure velocity."""

    @property
    def difference_filter_s(self) -> float | None:
        """Time constant of the first-order filter on the differences [s]; None: velocity is exact.

        0 is a difference without a filter.
        """
        ...


class DeviceSettings(Protocol):
    """A driver's own settings, a frozen dataclass of the driver's module."""

    @property
    def driver(self) -> str:
        """Name of the driver in the registry."""
        ...
