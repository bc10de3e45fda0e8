"""Device drivers by name; a driver's module, and its vendor's library, load when it is asked for.

A driver is a `DriverEntry` named by "module:attribute": a built-in below, or one that an installed
package offers as an entry point of the group "farhand.drivers".
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from hardware.interface import ContactForce, Device, DeviceConfigurationError, nearest_names

if TYPE_CHECKING:
    from hardware.robot_model import RobotModel

ENTRY_POINT_GROUP = "farhand.drivers"

_BUILT_IN = {
    "quanser": "hardware.quanser:DRIVER",
    "simulated": "hardware.simulated:DRIVER",
}


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """What a site gives a driver besides its settings.

    `now_ns` is the site's monotonic clock, `session_start_ns` the reading of it at session time
    zero. `contact` acts on simulated arms only.
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
    The factory touches no hardware and may raise DeviceConfigurationError.
    """

    settings: type[Any]
    create: Callable[[Any, DeviceContext], Device]


def drivers() -> tuple[str, ...]:
    """Return the names of all drivers, none of them loaded."""
    return tuple(sorted(_targets()))


def driver(name: str) -> DriverEntry:
    """Load a driver; raises DeviceConfigurationError if it is unknown or cannot be loaded."""
    targets = _targets()
    if name not in targets:
        raise DeviceConfigurationError(
            f"there is no driver {name!r}; nearest: {nearest_names(name, targets)}"
        )
    module, _, attribute = targets[name].partition(":")
    try:
        entry = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, OSError) as error:  # OSError: a vendor's shared library
        raise DeviceConfigurationError(
            f"driver {name!r} ({targets[name]}) cannot be loaded: {error}"
        ) from error
    if not isinstance(entry, DriverEntry):
        raise DeviceConfigurationError(
            f"driver {name!r}: {targets[name]} is a {type(entry).__name__}, not a DriverEntry"
        )
    return entry


def _targets() -> dict[str, str]:
    offered = {point.name: point.value for point in entry_points(group=ENTRY_POINT_GROUP)}
    return offered | _BUILT_IN
