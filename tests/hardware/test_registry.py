"""Drivers are found by name, and loaded no sooner than asked for."""

import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint

import pytest

from hardware import registry
from hardware.interface import DeviceConfigurationError
from hardware.registry import (
    ENTRY_POINT_GROUP,
    SENSOR_ENTRY_POINT_GROUP,
    DeviceContext,
    DriverEntry,
    SensorEntry,
    driver,
    drivers,
    force_sensor,
    force_sensors,
)
from hardware.robot_model import PlanarArm, build_robot
from hardware.simulated import SimulatedSettings


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Pretend that an installed package offers drivers."""

    def offer(**targets: str) -> None:
        def entry_points(group: str) -> list[EntryPoint]:
            assert group in ("farhand.drivers", "farhand.force_sensors")
            return [EntryPoint(name, value, group) for name, value in targets.items()]

        monkeypatch.setattr(registry, "entry_points", entry_points)

    return offer


def test_the_simulated_driver_builds_a_device() -> None:
    entry = driver("simulated")
    assert entry.settings is SimulatedSettings
    model = build_robot(PlanarArm("planar", (0.3, 0.3), (1.0, 1.0)), None)
    context = DeviceContext(model, None, now_ns=lambda: 5, session_start_ns=0, seed=1)
    device = entry.create(SimulatedSettings((0.1, 0.2)), context)
    device.open()
    assert device.joints == 2
    assert device.read().stamp_ns == 5
    device.close()


@pytest.mark.parametrize("name", ["simulatd", "Simulated", "nothing"])
def test_an_unknown_name_is_answered_with_the_nearest(name: str) -> None:
    with pytest.raises(DeviceConfigurationError, match=r"no driver '.*'; nearest: .*simulated"):
        driver(name)


def test_installed_packages_may_add_drivers_but_not_replace_one(
    offer: Callable[..., None],
) -> None:
    offer(other="hardware.simulated:DRIVER", simulated="nowhere:DRIVER")
    assert "other" in drivers()
    assert drivers().count("simulated") == 1
    assert isinstance(driver("other"), DriverEntry)
    assert driver("simulated").settings is SimulatedSettings


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (
            "no_such_module:DRIVER",
            r"'broken' \(no_such_module:DRIVER\) cannot be loaded: No module",
        ),
        ("hardware.simulated:NOTHING", "cannot be loaded: .*NOTHING"),
        ("hardware.simulated:SimulatedSettings", "is a type, not a DriverEntry"),
    ],
)
def test_a_broken_driver_is_explained(
    offer: Callable[..., None], target: str, message: str
) -> None:
    offer(broken=target)
    assert "broken" in drivers()  # listing loads nothing
    with pytest.raises(DeviceConfigurationError, match=message):
        driver("broken")


def test_listing_drivers_loads_none() -> None:
    program = (
        "import sys; from hardware.registry import drivers, force_sensors; "
        "assert 'simulated' in drivers() and 'jr3' in force_sensors(); "
        "sys.exit(bool({'hardware.simulated', 'hardware.jr3', 'pinocchio'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_installed_packages_may_add_force_sensors(offer: Callable[..., None]) -> None:
    offer(other="hardware.jr3:DRIVER", jr3="nowhere:DRIVER", arm="hardware.simulated:DRIVER")
    assert force_sensors() == ("arm", "jr3", "other")
    assert isinstance(force_sensor("other"), SensorEntry)
    assert isinstance(force_sensor("jr3"), SensorEntry)
    with pytest.raises(DeviceConfigurationError, match="is a DriverEntry, not a SensorEntry"):
        force_sensor("arm")
    with pytest.raises(DeviceConfigurationError, match="is a SensorEntry, not a DriverEntry"):
        driver("other")


def test_an_unknown_force_sensor_is_answered_with_the_nearest() -> None:
    with pytest.raises(DeviceConfigurationError, match=r"no force sensor 'jr4'; nearest: .*jr3"):
        force_sensor("jr4")


def test_the_entry_point_groups_are_public_names() -> None:
    assert ENTRY_POINT_GROUP == "farhand.drivers"
    assert SENSOR_ENTRY_POINT_GROUP == "farhand.force_sensors"
