"""What a site is made of fits together, or is refused before anything opens."""

from dataclasses import replace
from pathlib import Path

import pytest

from hardware.interface import DeviceConfigurationError
from hardware.registry import DeviceContext
from hardware.sensed import SensedDevice
from site_runtime.assembly import device_of
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import load_session

SESSION = load_session(Path(__file__).parents[2] / "experiments" / "bench_fake.toml")


def context(site: SiteId) -> DeviceContext:
    return DeviceContext(robot_of(SESSION, site), None, lambda: 0, 0, 1)


def test_a_site_s_device_has_its_robot_s_joints_and_its_sensor() -> None:
    local = device_of(SESSION.local, context(SiteId.LOCAL))
    assert isinstance(local, SensedDevice)
    assert local.joints == 2
    remote = device_of(SESSION.remote, context(SiteId.REMOTE))
    assert not isinstance(remote, SensedDevice)
    assert remote.joints == 4


def test_a_driver_of_another_number_of_joints_is_refused() -> None:
    remote = replace(SESSION.remote, device=SESSION.local.device)
    with pytest.raises(
        DeviceConfigurationError, match="driver 'phantom' moves 2 joints, the robot has 4"
    ):
        device_of(remote, context(SiteId.REMOTE))
