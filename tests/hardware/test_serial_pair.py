"""Two devices as one: neither runs without the other."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from hardware import registry
from hardware.interface import (
    DeviceConfigurationError,
    DeviceError,
    DeviceState,
    FloatArray,
    JointStops,
)
from hardware.registry import DeviceContext, DriverEntry
from hardware.robot_model import PlanarArm, build_robot
from hardware.serial_pair import DRIVER, SerialPair, SerialPairSettings
from hardware.simulated import SimulatedSettings
from site_runtime.session import SessionFileError, parse_session

FIGURE_5 = Path(__file__).parents[2] / "experiments" / "figure_5.toml"


@dataclass
class Part:
    """A device of two joints that notes its calls, and fails in the methods it is told to."""

    name: str
    log: list[str]
    first: float
    stamp_ns: int = 0
    fails: set[str] = field(default_factory=set)
    torque_nm: FloatArray | None = None
    joints: int = 2
    joint_stops: JointStops = field(default_factory=lambda: JointStops.none(2))
    clutch: bool = False

    def _call(self, method: str) -> None:
        self.log.append(f"{self.name}.{method}")
        if method in self.fails:
            raise DeviceError(f"{method} broke")

    def open(self) -> None:
        self._call("open")

    def enable(self) -> None:
        self._call("enable")

    def read(self) -> DeviceState:
        self._call("read")
        values = self.first + np.arange(2.0)
        return DeviceState(
            values, 10.0 * values, np.full(6, self.first), self.stamp_ns, self.clutch
        )

    def write(self, torque_nm: FloatArray) -> None:
        self._call("write")
        self.torque_nm = torque_nm.copy()

    def stop(self) -> None:
        self.torque_nm = None
        self._call("stop")

    def close(self) -> None:
        self._call("close")


@dataclass
class Bench:
    log: list[str]
    near: Part
    far: Part
    pair: SerialPair

    def enabled(self) -> None:
        self.pair.open()
        self.pair.enable()
        self.pair.write(np.ones(4))
        self.log.clear()


@pytest.fixture
def bench() -> Bench:
    log: list[str] = []
    near, far = Part("near", log, 1.0), Part("far", log, 3.0)
    return Bench(log, near, far, SerialPair(near, far, 0.005))


def test_joints_are_the_proximal_ones_then_the_distal_ones(bench: Bench) -> None:
    bench.enabled()
    bench.near.stamp_ns, bench.far.stamp_ns = 7_000_000, 4_000_000
    state = bench.pair.read()
    np.testing.assert_array_equal(state.position_rad, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(state.velocity_rad_s, [10.0, 20.0, 30.0, 40.0])
    np.testing.assert_array_equal(state.wrench, np.full(6, 3.0))
    assert state.stamp_ns == 4_000_000
    bench.near.stamp_ns = 1_000_000
    assert bench.pair.read().stamp_ns == 1_000_000
    bench.pair.write(np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_array_equal(bench.near.torque_nm, [0.1, 0.2])
    np.testing.assert_array_equal(bench.far.torque_nm, [0.3, 0.4])


def test_stops_are_the_parts_each_on_its_own_joints(bench: Bench) -> None:
    bench.near.joint_stops = JointStops(np.array([[1.0, 2.0]]), np.array([-0.1]), np.array([0.1]))
    bench.far.joint_stops = JointStops(
        np.array([[3.0, 0.0], [4.0, 5.0]]), np.array([-0.2, -0.3]), np.array([0.2, 0.3])
    )
    stops = bench.pair.joint_stops
    np.testing.assert_array_equal(
        stops.matrix, [[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 4.0, 5.0]]
    )
    np.testing.assert_array_equal(stops.lower_rad, [-0.1, -0.2, -0.3])
    np.testing.assert_array_equal(stops.upper_rad, [0.1, 0.2, 0.3])
    bench.near.joint_stops = JointStops.none(2)
    np.testing.assert_array_equal(
        bench.pair.joint_stops.matrix, [[0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 4.0, 5.0]]
    )


def test_the_button_of_either_is_the_clutch(bench: Bench) -> None:
    bench.enabled()
    assert not bench.pair.read().clutch
    for part in (bench.near, bench.far):
        part.clutch = True
        assert bench.pair.read().clutch
        part.clutch = False


def test_opening_is_undone_when_the_second_part_fails(bench: Bench) -> None:
    bench.far.fails = {"open"}
    with pytest.raises(DeviceError, match="distal part: open broke"):
        bench.pair.open()
    assert bench.log[:2] == ["near.open", "far.open"]
    assert "near.close" in bench.log
    with pytest.raises(DeviceError, match="not open"):
        bench.pair.read()
    bench.far.fails = set()
    bench.pair.open()
    bench.pair.enable()
    bench.pair.read()


def test_enabling_is_undone_when_the_second_part_fails(bench: Bench) -> None:
    bench.pair.open()
    bench.far.fails = {"enable"}
    with pytest.raises(DeviceError, match="distal part: enable broke"):
        bench.pair.enable()
    assert bench.log[-2:] == ["near.stop", "far.stop"]
    with pytest.raises(DeviceError, match="enable broke"):
        bench.pair.write(np.zeros(4))


@pytest.mark.parametrize("broken", ["near", "far"])
@pytest.mark.parametrize("method", ["enable", "read", "write"])
def test_a_fault_of_either_stops_both_and_latches(bench: Bench, method: str, broken: str) -> None:
    bench.enabled()
    part: Part = getattr(bench, broken)
    part.fails = {method}
    where = {"near": "proximal", "far": "distal"}[broken]
    calls: dict[str, Callable[[], object]] = {
        "enable": bench.pair.enable,
        "read": bench.pair.read,
        "write": lambda: bench.pair.write(np.ones(4)),
    }
    with pytest.raises(DeviceError, match=f"{where} part: {method} broke"):
        calls[method]()
    other = "far" if broken == "near" else "near"
    assert bench.log[-2:] == [f"{other}.stop", f"{broken}.stop"]  # the sound one does not wait
    assert bench.near.torque_nm is None
    assert bench.far.torque_nm is None
    part.fails = set()
    bench.log.clear()
    for call in calls.values():
        with pytest.raises(DeviceError, match=f"{where} part: {method} broke; close it"):
            call()
    bench.pair.stop()
    with pytest.raises(DeviceError, match=f"{method} broke"):  # stopping mends nothing
        bench.pair.enable()
    assert not {"near.write", "far.write", "near.enable", "far.enable"} & set(bench.log)
    bench.pair.close()
    bench.enabled()
    bench.pair.write(np.ones(4))


def test_an_error_that_no_driver_should_raise_stops_both_too(bench: Bench) -> None:
    bench.enabled()

    def broken() -> DeviceState:
        raise ZeroDivisionError("a driver's bug")

    bench.far.read = broken  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="distal part: a driver's bug"):
        bench.pair.read()
    assert bench.log[-2:] == ["near.stop", "far.stop"]


def test_a_part_whose_stop_fails_does_not_keep_the_other_on(bench: Bench) -> None:
    bench.enabled()
    bench.far.fails = bench.near.fails = {"stop", "close"}
    bench.pair.stop()
    assert bench.log == ["near.stop", "far.stop"]
    bench.pair.close()
    assert bench.log[-2:] == ["near.close", "far.close"]


@pytest.mark.parametrize(("late", "where"), [("near", "proximal"), ("far", "distal")])
def test_readings_too_far_apart_are_a_fault(bench: Bench, late: str, where: str) -> None:
    bench.enabled()
    bench.near.stamp_ns = bench.far.stamp_ns = 100_000_000
    part: Part = getattr(bench, late)
    part.stamp_ns -= 5_000_000
    bench.pair.read()
    part.stamp_ns -= 1
    with pytest.raises(DeviceError, match=rf"{where} part: its reading is 5.0 ms older"):
        bench.pair.read()
    other = "far" if late == "near" else "near"
    assert bench.log[-2:] == [f"{other}.stop", f"{late}.stop"]
    part.stamp_ns += 5_000_000
    with pytest.raises(DeviceError, match=r"5\.0 ms older"):
        bench.pair.read()


def test_a_refused_torque_reaches_neither_part(bench: Bench) -> None:
    bench.enabled()
    for torque_nm in (np.array([0.0, 0.0, 0.0, np.nan]), np.zeros(2)):
        with pytest.raises(DeviceError, match="torque refused"):
            bench.pair.write(torque_nm)
    assert bench.log == []
    bench.pair.write(np.ones(4))  # and is no fault


def session_with(device: str) -> str:
    text = FIGURE_5.read_text(encoding="utf-8")
    start = text.index("[remote.device]")
    end = text.index("[remote.null_space]")
    limits = (
        "[remote.limits]\ntorque_nm = [1.0, 1.0, 1.0, 1.0]\nvelocity_rad_s = [9.0, 9.0, 9.0, 9.0]\n"
    )
    return f"{text[:start]}[remote.device]\n{device}\n{limits}\n{text[end:]}"


PART = (
    '{ driver = "simulated", initial_position_rad = [0.1, 0.2], '
    "encoder_resolution_rad = 1e-4, velocity_filter_s = %s }"
)
PAIR = f'driver = "serial_pair"\nproximal = {PART % 0.002}\ndistal = {PART % 0.004}'


def test_a_session_file_names_the_parts_by_nested_tables() -> None:
    device = parse_session(session_with(PAIR), FIGURE_5).remote.device
    assert isinstance(device, SerialPairSettings)
    assert isinstance(device.distal, SimulatedSettings)
    assert device.distal.initial_position_rad == (0.1, 0.2)
    assert device.difference_filter_s == 0.004


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("proximal = {", "proximal = { step_ms = 1,", "proximal.step_ms = 1: .*step_s"),
        ('simulated", initial', 'simlated", initial', 'proximal.driver = "simlated".*simulated'),
        ("distal = {", "distal = 3 #", "distal = 3: must be a table"),
        ("distal = {", "dstal = {", "dstal.*distal"),
        ("\nprox", "\nmax_skew_s = 0.2\nprox", "max_skew_s is 0.2; it must be above 0"),
    ],
)
def test_a_part_that_cannot_be_is_told_with_its_key(old: str, new: str, message: str) -> None:
    assert old in PAIR
    with pytest.raises(SessionFileError, match=rf"remote\.device\b.*{message}"):
        parse_session(session_with(PAIR.replace(old, new, 1)), FIGURE_5)


def test_the_parts_are_made_by_their_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class PartSettings:
        driver: str
        joints: int

    entry = DriverEntry(
        PartSettings, lambda settings, _: Part(settings.driver, [], 0.0, joints=settings.joints)
    )
    monkeypatch.setattr(registry, "driver", lambda name: entry)
    monkeypatch.setattr("hardware.serial_pair.driver", lambda name: entry)
    model = build_robot(PlanarArm("planar", (0.2,) * 4, (1.0,) * 4), None)
    context = DeviceContext(model, None, lambda: 0, 0, 1)
    settings = SerialPairSettings(PartSettings("a", 2), PartSettings("b", 2))
    assert DRIVER.create(settings, context).joints == 4
    settings = SerialPairSettings(PartSettings("a", 2), PartSettings("b", 3))
    with pytest.raises(
        DeviceConfigurationError, match=r"proximal \(a\) has 2 joints, distal \(b\) has 3; .* 4"
    ):
        DRIVER.create(settings, context)
