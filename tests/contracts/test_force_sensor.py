"""What every `ForceSensor` must do, whatever it reads; a new one joins with one factory."""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count

import can
import numpy as np
import pytest

from hardware import jr3
from hardware.interface import DeviceError, FloatArray, ForceReading, ForceSensor
from hardware.jr3 import Jr3, Jr3Settings
from tests.fakes.jr3_node import Jr3Node

pytestmark = pytest.mark.processes

LOAD = np.array([10.0, -5.0, 20.0, 0.5, 1.0, -0.25])  # N, N·m
_numbers = count()


class Clock:
    """The monotonic clock, which can be held."""

    held_ns: int | None = None

    def __call__(self) -> int:
        return time.monotonic_ns() if self.held_ns is None else self.held_ns


@dataclass
class Bench:
    """A sensor nobody has opened, and a hold on what it measures.

    `load` is the wrench ON the robot in the sensor's `mounting` axes; `unplug` and `replug` are of
    the cable; `garbage` makes the vendor's side talk nonsense; `read_precision` [N, N·m].
    """

    sensor: ForceSensor
    clock: Clock
    unplug: Callable[[], None]
    replug: Callable[[], None]
    garbage: Callable[[], None]
    dismantle: Callable[[], None]
    read_precision: float
    load: FloatArray = field(default_factory=lambda: np.zeros(6))


def jr3_on(sensor_bus: dict[str, str], node_bus: Callable[[], can.BusABC], number: int) -> Bench:
    clock = Clock()
    settings = Jr3Settings(
        **sensor_bus,
        node=number,
        mounting="base",
        # x of the sensor is −y of the base, y is x: a quarter turn about z.
        rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        cutoff_hz=655.0,
        tare_samples=5,
        stale_after_s=0.5,
    )
    node = Jr3Node(
        node_bus(),
        node=number,
        wrench=lambda _: bench.load,
        rotation=settings.rotation,
        zero_at_start=False,
    )

    def dismantle() -> None:
        bench.sensor.close()
        node.stop()

    bench = Bench(
        Jr3(settings, clock),
        clock,
        unplug=lambda: setattr(node, "mute", True),
        replug=lambda: setattr(node, "mute", False),
        garbage=lambda: node.garbage(0x600, b"\xff\xff\xff"),
        dismantle=dismantle,
        read_precision=0.02,  # one raw unit is 0.011 N
    )
    node.start()
    return bench


def jr3_virtual() -> Bench:
    channel = f"force-sensor-{next(_numbers)}"
    return jr3_on(
        {"interface": "virtual", "channel": channel},
        lambda: can.Bus(interface="virtual", channel=channel),
        number=1,
    )


def jr3_udp_multicast() -> Bench:
    group = "239.74.163.2"
    try:
        can.Bus(interface="udp_multicast", channel=group, fd=False, hop_limit=0).shutdown()
    except (can.CanError, OSError) as error:
        pytest.skip(f"no IPv4 multicast on this machine: {error}")
    return jr3_on(
        {"interface": "udp_multicast", "channel": group},
        lambda: can.Bus(interface="udp_multicast", channel=group, fd=False, hop_limit=0),
        number=1 + os.getpid() % 127,  # every test run on this machine is on the same bus
    )


def jr3_socketcan() -> Bench:
    channel = "vcan0"
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((channel,))
    except OSError as error:
        pytest.skip(
            f"no {channel} ({error}): modprobe vcan, ip link add {channel} type vcan, "
            f"ip link set {channel} up"
        )
    return jr3_on(
        {"interface": "socketcan", "channel": channel},
        lambda: can.Bus(interface="socketcan", channel=channel),
        number=1 + os.getpid() % 127,
    )


FACTORIES: tuple[Callable[[], Bench], ...] = (jr3_virtual, jr3_udp_multicast, jr3_socketcan)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jr3, "_SETTLE_S", 0.01)


@pytest.fixture(params=FACTORIES, ids=lambda factory: factory.__name__)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench: Bench = request.param()
    yield bench
    bench.dismantle()


@pytest.fixture
def opened(bench: Bench) -> Bench:
    bench.sensor.open()
    return bench


def eventually(condition: Callable[[], bool]) -> None:
    limit_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < limit_s, "in vain"
        time.sleep(0.001)


def newer(bench: Bench, than: ForceReading, times: int = 1) -> ForceReading:
    """Wait for readings newer than one, so many in turn."""
    for _ in range(times):
        eventually(lambda: bench.sensor.read().stamp_ns > than.stamp_ns)  # noqa: B023
        than = bench.sensor.read()
    return than


def fails(bench: Bench) -> bool:
    try:
        bench.sensor.read()
    except DeviceError:
        return True
    return False


def settled(bench: Bench, wrench: FloatArray) -> bool:
    return bool(np.abs(bench.sensor.read().wrench - wrench).max() < bench.read_precision)


def test_a_reading_is_finite_fresh_and_of_the_declared_shape(opened: Bench) -> None:
    before_ns = time.monotonic_ns()
    reading = newer(opened, opened.sensor.read(), 3)
    assert reading.wrench.shape == (6,)
    assert reading.wrench.dtype == np.float64
    assert np.isfinite(reading.wrench).all()
    assert isinstance(reading.stamp_ns, int)
    assert before_ns < reading.stamp_ns <= time.monotonic_ns()
    assert reading.saturated is False


def test_units_and_signs_are_newtons_and_newton_metres_on_the_robot(opened: Bench) -> None:
    assert opened.sensor.mounting in ("base", "end_effector")
    for axis in range(6):
        opened.load = np.zeros(6)
        opened.load[axis] = LOAD[axis]
        eventually(lambda: settled(opened, opened.load))


def test_stamps_never_run_backwards(opened: Bench) -> None:
    stamps = []
    last = opened.sensor.read()
    while len(set(stamps)) < 20:
        last = newer(opened, last) if len(stamps) % 2 else opened.sensor.read()
        stamps.append(last.stamp_ns)
    assert (np.diff(stamps) >= 0).all()


def test_reading_waits_for_nothing(opened: Bench) -> None:
    opened.clock.held_ns = time.monotonic_ns()  # so that nothing gets stale
    opened.unplug()
    last = None
    for _ in range(100):  # frames under way may still arrive; then the last reading stands
        last = opened.sensor.read()
    assert last is not None
    assert opened.sensor.read().stamp_ns <= opened.clock.held_ns


def test_a_reading_stays_as_it_was(opened: Bench) -> None:
    reading = opened.sensor.read()
    kept = reading.wrench.copy()
    opened.load = LOAD
    eventually(lambda: settled(opened, LOAD))
    np.testing.assert_array_equal(reading.wrench, kept)


def test_opening_takes_the_present_load_as_zero(bench: Bench) -> None:
    bench.load = LOAD
    bench.sensor.open()
    assert settled(bench, np.zeros(6))
    bench.load = np.zeros(6)
    eventually(lambda: settled(bench, -LOAD))


def test_tare_makes_the_present_load_the_zero(opened: Bench) -> None:
    opened.load = LOAD
    eventually(lambda: settled(opened, LOAD))
    opened.sensor.tare()
    assert settled(opened, np.zeros(6))
    opened.load = 2.0 * LOAD
    eventually(lambda: settled(opened, LOAD))


@pytest.mark.parametrize("closed", [False, True])
def test_a_sensor_that_is_not_open_neither_reads_nor_tares(bench: Bench, closed: bool) -> None:
    if closed:
        bench.sensor.open()
        bench.sensor.close()
    for call in (bench.sensor.read, bench.sensor.tare):
        with pytest.raises(DeviceError, match="not open"):
            call()


def test_opening_an_open_sensor_is_refused_and_does_it_no_harm(opened: Bench) -> None:
    with pytest.raises(DeviceError, match="already open"):
        opened.sensor.open()
    newer(opened, opened.sensor.read())


@pytest.mark.parametrize("stage", ["new", "open", "unplugged", "failed", "closed"])
def test_close_is_always_allowed_and_may_be_repeated(bench: Bench, stage: str) -> None:
    if stage != "new":
        bench.sensor.open()
    if stage in ("unplugged", "failed"):
        bench.unplug()
    if stage == "failed":
        eventually(lambda: fails(bench))
    for _ in range(3):
        bench.sensor.close()
    bench.replug()
    bench.sensor.open()
    newer(bench, bench.sensor.read())


@pytest.mark.parametrize("mischief", ["unplug", "garbage"])
def test_a_fault_latches_until_the_sensor_is_closed_and_opened(
    opened: Bench, mischief: str
) -> None:
    getattr(opened, mischief)()
    eventually(lambda: fails(opened))
    with pytest.raises(DeviceError) as first:
        opened.sensor.read()
    opened.replug()
    for call in (opened.sensor.read, opened.sensor.tare, opened.sensor.read):
        with pytest.raises(DeviceError) as later:
            call()
        assert str(later.value) == str(first.value)
    opened.sensor.close()
    opened.sensor.open()
    newer(opened, opened.sensor.read(), 3)


def test_an_unplugged_sensor_does_not_open_and_leaves_nothing_behind(bench: Bench) -> None:
    bench.unplug()
    threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))
    with pytest.raises(DeviceError):
        bench.sensor.open()
    assert threading.active_count() == threads
    assert len(os.listdir("/proc/self/fd")) == files
    with pytest.raises(DeviceError, match="not open"):
        bench.sensor.read()


def test_opening_and_closing_leaks_nothing(bench: Bench) -> None:
    def one_round() -> None:
        bench.sensor.open()
        bench.sensor.read()
        bench.sensor.close()

    one_round()  # what is loaded once is no leak
    threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))
    for _ in range(50):
        one_round()
    assert threading.active_count() == threads
    assert len(os.listdir("/proc/self/fd")) == files
