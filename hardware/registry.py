"""Drivers of devices and force sensors by name; a driver's module loads when it is asked for.

A driver is a `DriverEntry`, one of a force sensor a `SensorEntry`, named by "module:attribute": a
built-in below, or one that an installed package offers as an entry point of the group
"farhand.drivers" or "farhand.force_sensors".
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, TypeVar

from hardware.interface import (
    ContactForce,
    Device,
    DeviceConfigurationError,
    ForceSensor,
    nearest_names,
)

if TYPE_CHECKING:
    from hardware.robot_model import RobotModel

ENTRY_POINT_GROUP = "farhand.drivers"
SENSOR_ENTRY_POINT_GROUP = "farhand.force_sensors"

_BUILT_IN = {
    "phantom": "hardware.phantom:DRIVER",
    "quanser": "hardware.quanser:DRIVER",
    "serial_pair": "hardware.serial_pair:DRIVER",
    "simulated": "hardware.simulated:DRIVER",
}
_BUILT_IN_SENSORS = {"jr3": "hardware.jr3:DRIVER"}


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """What a site gives a driver besides its settings.

    `now_ns` is the site's monotonic clock, `session_start_ns` the reading of it at session time
    zero. `model` is the whole robot, of which a device may be a part. `contact` acts on simulated
    arms only.
    """

    model: "RobotModel"
    contact: ContactForce | None
    now_ns: Callable[[], int]
    session_start_ns: int
    seed: int


@dataclass(frozen=True, slots=True)
class DriverEntry:
    """A driver: the dataclass of its settings, and the factory (settings, context) → Device.

    Settings of a device whose velocity is a difference of positions are `VelocityByDifference`.
    The factory touches no hardware and may raise DeviceConfigurationError. `missing` says what of
    the vendor's this machine lacks for these settings (None: for the usual ones) and how to get
    it, or None; it touches no device either.
    """

    settings: type[Any]
    create: Callable[[Any, DeviceContext], Device]
    missing: Callable[[Any | None], str | None] | None = None


@dataclass(frozen=True, slots=True)
class SensorEntry:
    """A force sensor's driver: the dataclass of its settings, and the factory → ForceSensor.

    The factory touches no hardware and may raise DeviceConfigurationError. `missing` is as in
    `DriverEntry`.
    """

    settings: type[Any]
    create: Callable[[Any, DeviceContext], ForceSensor]
    missing: Callable[[Any | None], str | None] | None = None


_Entry = TypeVar("_Entry", DriverEntry, SensorEntry)


def drivers() -> tuple[str, ...]:
    """Return the names of all drivers, none of them loaded."""
    return tuple(sorted(_targets(ENTRY_POINT_GROUP, _BUILT_IN)))


def driver(name: str) -> DriverEntry:
    """Load a driver; raises DeviceConfigurationError if it is unknown or cannot be loaded."""
    return _load("driver", name, _targets(ENTRY_POINT_GROUP, _BUILT_IN), DriverEntry)


def force_sensors() -> tuple[str, ...]:
    """Return the names of all force sensors' drivers, none of them loaded."""
    return tuple(sorted(_targets(SENSOR_ENTRY_POINT_GROUP, _BUILT_IN_SENSORS)))


def force_sensor(name: str) -> SensorEntry:
    """Load a force sensor's driver; raises DeviceConfigurationError as `driver` does."""
    targets = _targets(SENSOR_ENTRY_POINT_GROUP, _BUILT_IN_SENSORS)
    return _load("force sensor", name, targets, SensorEntry)


def missing(entry: DriverEntry | SensorEntry, settings: object | None = None) -> str | None:
    """Return what this machine lacks for a driver, and how to get it; None if nothing is known."""
    return None if entry.missing is None else entry.missing(settings)


def _load(what: str, name: str, targets: dict[str, str], kind: type[_Entry]) -> _Entry:
    if name not in targets:
        raise DeviceConfigurationError(
            f"there is no {what} {name!r}; nearest: {nearest_names(name, targets)}"
        )
    module, _, attribute = targets[name].partition(":")
    try:
        entry = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, OSError) as error:  # OSError: a vendor's shared library
        raise DeviceConfigurationError(
            f"{what} {name!r} ({targets[name]}) cannot be loaded: {error}"
        ) from error
    if not isinstance(entry, kind):
        raise DeviceConfigurationError(
            f"{what} {name!r}: {targets[name]} is a {type(entry).__name__}, not a {kind.__name__}"
        )
    return entry


def _targets(group: str, built_in: dict[str, str]) -> dict[str, str]:
    return {point.name: point.value for point in entry_points(group=group)} | built_in
