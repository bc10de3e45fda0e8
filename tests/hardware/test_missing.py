"""What a driver says that this machine lacks, for settings as a session has them."""

from dataclasses import replace
from pathlib import Path

import pytest

from hardware.jr3 import Jr3Settings
from hardware.phantom import PhantomSettings
from hardware.quanser import QuanserSettings
from hardware.registry import driver, force_sensor, missing
from hardware.serial_pair import SerialPairSettings
from site_runtime.session import load_session
from tests.fakes.hd import fake_hd

SESSION = load_session(Path(__file__).parents[2] / "experiments" / "bench_fake.toml")


@pytest.fixture
def pair() -> SerialPairSettings:
    settings = SESSION.remote.device
    assert isinstance(settings, SerialPairSettings)
    return settings


def test_a_library_that_is_not_there_is_named_with_its_source(tmp_path: Path) -> None:
    settings = SESSION.local.device
    assert isinstance(settings, PhantomSettings)
    lack = missing(driver("phantom"), replace(settings, library=str(tmp_path / "libHD.so")))
    assert lack is not None
    assert str(tmp_path / "libHD.so") in lack
    assert "3D Systems" in lack


def test_a_module_that_is_not_there_is_named_with_its_source(pair: SerialPairSettings) -> None:
    settings = pair.proximal
    assert isinstance(settings, QuanserSettings)
    lack = missing(driver("quanser"), replace(settings, module="nobodys.hardware"))
    assert lack is not None
    assert "nobodys.hardware" in lack
    assert "Quanser SDK" in lack
    there = replace(settings, module="tests.fakes.quanser_hardware")
    assert missing(driver("quanser"), there) is None


def test_a_pair_lacks_what_its_parts_lack(pair: SerialPairSettings) -> None:
    if reason := fake_hd.missing():
        pytest.skip(reason)
    near, far = pair.proximal, pair.distal
    assert isinstance(near, QuanserSettings)
    assert isinstance(far, PhantomSettings)
    there = replace(
        pair,
        proximal=replace(near, module="tests.fakes.quanser_hardware"),
        distal=replace(far, library=str(fake_hd.library())),
    )
    entry = driver("serial_pair")
    assert missing(entry, there) is None
    assert missing(entry) is None  # its parts are told under their own names
    lack = missing(entry, replace(there, proximal=replace(near, module="nobodys.hardware")))
    assert lack is not None
    assert "nobodys.hardware" in lack
    assert "libHD" not in lack


def test_a_can_interface_that_is_not_there_is_named() -> None:
    settings = SESSION.local.force_sensor
    assert isinstance(settings, Jr3Settings)
    assert missing(force_sensor("jr3"), settings) is None
    lack = missing(
        force_sensor("jr3"), replace(settings, interface="socketcan", channel="nowhere0")
    )
    assert lack is not None
    assert "'nowhere0'" in lack
    assert "ip link set" in lack
    present = replace(settings, interface="socketcan", channel="lo")
    assert missing(force_sensor("jr3"), present) is None
