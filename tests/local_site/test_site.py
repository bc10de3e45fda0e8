from dataclasses import replace
from pathlib import Path

from channel.memory_link import memory_links
from hardware.jr3 import Jr3, Jr3Settings
from hardware.sensed import SensedDevice
from hardware.simulated import SimulatedDevice
from local_site.controller import LocalController
from local_site.operators import HumanArm
from local_site.site import build_local_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.keys import SiteId
from site_runtime.session import load_session

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def test_the_site_is_built_as_the_session_file_says() -> None:
    session = load_session(EXPERIMENTS / "demo.toml")
    link = memory_links()[0]
    site = build_local_site(session, Surroundings(link, ManualClock(), 0, 1, lambda _: None))
    controller = site._controller
    assert site.identity is SiteId.LOCAL
    assert isinstance(controller, LocalController)
    assert tuple(controller.damping.task) == session.local.damping.task_n_s_per_m
    assert tuple(controller.coupling.stiffness) == session.coupling.stiffness_n_per_m
    assert isinstance(site._device._contact, HumanArm)


def test_a_force_sensor_of_the_session_joins_the_device() -> None:
    session = load_session(EXPERIMENTS / "demo.toml")
    sensor = Jr3Settings(
        interface="virtual",
        channel="none",
        node=5,
        mounting="base",
        rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    )
    session = replace(session, local=replace(session.local, force_sensor=sensor))
    clock = ManualClock()
    site = build_local_site(session, Surroundings(memory_links()[0], clock, 0, 1, lambda _: None))
    device = site._device
    assert isinstance(device, SensedDevice)
    assert isinstance(device._device, SimulatedDevice)
    assert isinstance(device._sensor, Jr3)
    assert device._sensor._settings is sensor
    assert device._sensor._now_ns == clock.now_ns
