"""Two devices in series as one robot: the paper's remote arm, a PHANToM on a Quanser robot.

Each part's own driver presents serial joint angles, radians and newton metres: with
q = A d + b and τ_d = Aᵀ τ_q, A is diag(A_proximal, A_distal), and each block is its driver's. The
distal base rides on the last proximal link, so its angles need no term of the proximal ones, and
its reaction on the proximal joints is already in the generalised torques. What is left here is
concatenation, and that neither part runs without the other.
"""

from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Literal, cast

import numpy as np
from pydantic import Field, PlainValidator, ValidationInfo

from hardware.interface import (
    Device,
    DeviceConfigurationError,
    DeviceError,
    DeviceSettings,
    DeviceState,
    FloatArray,
    JointStops,
    VelocityByDifference,
)
from hardware.registry import DeviceContext, DriverEntry, driver, missing

LARGEST_SKEW_S = 0.1


def _part(table: object, info: ValidationInfo) -> DeviceSettings:
    """Validate a part's table the way the session's device tables are validated."""
    if info.context is None:
        raise DeviceConfigurationError("a part's settings need a validator of device tables")
    return cast(DeviceSettings, info.context(table))


Part = Annotated[
    DeviceSettings,
    PlainValidator(_part),
    Field(description="a table with driver = a driver's name, and that driver's settings"),
]


@dataclass(frozen=True, slots=True)
class SerialPairSettings:
    """Settings of the driver "serial_pair": its two parts, and how far apart they may be in time.

    `max_skew_s` limits the difference of their readings' stamps: the end effector is in error by
    at most that time its speed.
    """

    proximal: Part
    distal: Part
    driver: Literal["serial_pair"] = "serial_pair"
    max_skew_s: float = 0.005

    def __post_init__(self) -> None:
        if not 0.0 < self.max_skew_s <= LARGEST_SKEW_S:
            raise DeviceConfigurationError(
                f"max_skew_s is {self.max_skew_s}; it must be above 0 and at most {LARGEST_SKEW_S}"
            )

    @property
    def difference_filter_s(self) -> float | None:
        """Time constant of the slower part's velocity filter [s]; None: both are exact."""
        filters = [
            part.difference_filter_s
            for part in (self.proximal, self.distal)
            if isinstance(part, VelocityByDifference) and part.difference_filter_s is not None
        ]
        return max(filters, default=None)


class SerialPair:
    """A `Device` whose joints are those of `proximal`, then those of `distal`.

    A reading is as old as the older of the two; its wrench is the distal one. Whatever a part
    raises, in whichever method, stops both at once, and is what every later call says until the
    pair is closed and opened again.
    """

    def __init__(self, proximal: Device, distal: Device, max_skew_s: float) -> None:
        self._parts = {"proximal": proximal, "distal": distal}
        self._split = proximal.joints
        self._joints = proximal.joints + distal.joints
        self._max_skew_ns = round(max_skew_s * 1e9)
        self._opened = False
        self._enabled = False
        self._fault: str | None = None

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self._joints

    @property
    def joint_stops(self) -> JointStops:
        """Those of both parts."""
        near, far = (part.joint_stops for part in self._parts.values())
        matrix = np.zeros((len(near.matrix) + len(far.matrix), self._joints))
        matrix[: len(near.matrix), : self._split] = near.matrix
        matrix[len(near.matrix) :, self._split :] = far.matrix
        return JointStops(
            matrix,
            np.concatenate((near.lower_rad, far.lower_rad)),
            np.concatenate((near.upper_rad, far.upper_rad)),
        )

    def open(self) -> None:
        """Open both, or neither."""
        if self._opened:
            raise DeviceError("the serial pair is already open; close it first")
        self._fault = None
        for name, part in self._parts.items():
            try:
                part.open()
            except Exception as error:
                self.close()
                raise DeviceError(f"{name} part: {error}") from error
        self._opened = True

    def enable(self) -> None:
        """Switch both on, or neither."""
        self._require_working()
        for name, part in self._parts.items():
            try:
                part.enable()
            except Exception as error:
                raise self._failed(name, error) from error
        self._enabled = True

    def read(self) -> DeviceState:
        """Return both readings as one."""
        self._require_working()
        name = ""
        try:
            name = "proximal"
            near = self._parts[name].read()
            name = "distal"
            far = self._parts[name].read()
        except Exception as error:
            raise self._failed(name, error) from error
        skew_ns = far.stamp_ns - near.stamp_ns
        if abs(skew_ns) > self._max_skew_ns:
            late = "proximal" if skew_ns > 0 else "distal"
            raise self._failed(
                late,
                f"its reading is {abs(skew_ns) * 1e-6:.1f} ms older than the other part's; "
                f"max_skew_s allows {self._max_skew_ns * 1e-6:g} ms",
            )
        return DeviceState(
            np.concatenate((near.position_rad, far.position_rad)),
            np.concatenate((near.velocity_rad_s, far.velocity_rad_s)),
            far.wrench,
            min(near.stamp_ns, far.stamp_ns),
            near.clutch or far.clutch,
        )

    def write(self, torque_nm: FloatArray) -> None:
        """Command both; what one of them would refuse reaches neither."""
        self._require_no_fault()
        if not self._enabled:
            raise DeviceError("torque refused: the outputs are off; call enable() first")
        if torque_nm.shape != (self._joints,):
            raise DeviceError(f"torque refused: shape {torque_nm.shape}, not ({self._joints},)")
        if not np.isfinite(torque_nm).all():
            raise DeviceError(f"torque refused: {torque_nm} N·m is not finite")
        name = ""
        try:
            name = "proximal"
            self._parts[name].write(torque_nm[: self._split])
            name = "distal"
            self._parts[name].write(torque_nm[self._split :])
        except Exception as error:
            raise self._failed(name, error) from error

    def stop(self) -> None:
        """Stop both."""
        self._stop(last="distal")

    def close(self) -> None:
        """Stop both, then close both."""
        self.stop()
        self._opened = False
        for part in self._parts.values():
            with suppress(Exception):
                part.close()

    def _stop(self, last: str) -> None:
        self._enabled = False
        for name in sorted(self._parts, key=lambda name: name == last):
            with suppress(Exception):  # a part that breaks its promise must not keep the other on
                self._parts[name].stop()

    def _failed(self, name: str, cause: object) -> DeviceError:
        self._stop(last=name)  # it may be long about its stop
        self._fault = f"{name} part: {cause}"
        return DeviceError(self._fault)

    def _require_no_fault(self) -> None:
        if self._fault is not None:
            raise DeviceError(f"the serial pair failed: {self._fault}; close it and open it again")

    def _require_working(self) -> None:
        self._require_no_fault()
        if not self._opened:
            raise DeviceError("the serial pair is not open; call open() first")


def _create(settings: SerialPairSettings, context: DeviceContext) -> SerialPair:
    proximal, distal = (
        driver(part.driver).create(part, context) for part in (settings.proximal, settings.distal)
    )
    if proximal.joints + distal.joints != context.model.joints:
        raise DeviceConfigurationError(
            f"proximal ({settings.proximal.driver}) has {proximal.joints} joints, distal "
            f"({settings.distal.driver}) has {distal.joints}; the robot has {context.model.joints}"
        )
    return SerialPair(proximal, distal, settings.max_skew_s)


def _missing(settings: SerialPairSettings | None) -> str | None:
    """Say what the parts lack; without settings, they are told under their own names."""
    parts = () if settings is None else (settings.proximal, settings.distal)
    lacks = [missing(driver(part.driver), part) for part in parts]
    return "; ".join(lack for lack in lacks if lack is not None) or None


DRIVER = DriverEntry(settings=SerialPairSettings, create=_create, missing=_missing)
