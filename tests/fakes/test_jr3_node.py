"""The pretended JR3 board has the real one's traps, else the driver's tests prove little."""

import itertools
import struct
import time
from collections.abc import Callable, Iterator

import can
import numpy as np
import pytest

from tests.fakes.jr3_node import FULL_SCALES, RAW_FULL_SCALE, Jr3Node

START = struct.pack("<HI", 65_535, 1000)
_channels = (f"node-{number}" for number in itertools.count())


class Host:
    def __init__(self, sensor: bool = True, zero_at_start: bool = False) -> None:
        channel = next(_channels)
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.load = np.array([11.5, 0.0, 0.0, 0.0, 0.0, 0.61])  # a tenth of full scale
        self.node = Jr3Node(
            can.Bus(interface="virtual", channel=channel),
            node=5,
            wrench=lambda _: self.load,
            sensor=sensor,
            zero_at_start=zero_at_start,
        )
        self.node.start()

    def dismantle(self) -> None:
        self.node.stop()
        self.bus.shutdown()

    def send(self, opcode: int, data: bytes = b"") -> None:
        self.bus.send(can.Message(arbitration_id=opcode | 5, is_extended_id=False, data=data))

    def receive(self, opcode: int) -> bytes:
        limit_s = time.monotonic() + 20.0
        while time.monotonic() < limit_s:
            message = self.bus.recv(0.1)
            if message is not None and message.arbitration_id == opcode | 5:
                return bytes(message.data)
        raise AssertionError(f"no frame {opcode:#x}")

    def ask(self, opcode: int, data: bytes = b"") -> bytes:
        self.send(opcode, data)
        return self.receive(0x100)

    def force_x(self, wanted: Callable[[int], bool]) -> int:
        """Wait for a force along x that is as wanted."""
        limit_s = time.monotonic() + 20.0
        while not wanted(x := struct.unpack("<3hH", self.receive(0x600))[0]):
            assert time.monotonic() < limit_s, f"in vain; the last was {x}"
        return int(x)


@pytest.fixture
def host() -> Iterator[Host]:
    host = Host()
    yield host
    host.dismantle()


def test_it_says_that_it_has_booted_and_tells_its_state_and_scales(host: Host) -> None:
    assert host.receive(0x700) == b""
    assert host.ask(0x400) == b"\x00"
    assert host.ask(0x480) == b"\x00" + struct.pack("<3H", *FULL_SCALES[:3])
    assert host.ask(0x500) == b"\x00" + struct.pack("<3H", *FULL_SCALES[3:])


def test_it_sends_force_and_moment_with_one_counter_at_the_sensor_s_rate(host: Host) -> None:
    assert host.ask(0x200, START) == b"\x00"
    tenth = RAW_FULL_SCALE // 10
    host.force_x(lambda x: abs(x - tenth) <= 1)
    first = struct.unpack("<3hH", host.receive(0x600))
    moments = struct.unpack("<3hH", host.receive(0x680))
    assert abs(moments[2] - tenth) <= 1
    assert moments[3] == first[3]
    started_s = time.monotonic()
    while time.monotonic() < started_s + 0.05:
        later = struct.unpack("<3hH", host.receive(0x600))
    assert later[3] - first[3] > 0.05 / 128.5e-6 * 0.8


def test_stop_loses_the_zero_and_the_counter(host: Host) -> None:
    host.ask(0x200, START)
    host.force_x(lambda x: abs(x - RAW_FULL_SCALE // 10) <= 1)  # settled: a zero is one sample
    host.ask(0x300)
    host.force_x(lambda x: abs(x) < 10)
    host.ask(0x280)
    host.ask(0x200, START)
    host.force_x(lambda x: x > 1600)
    assert struct.unpack("<3hH", host.receive(0x600))[3] < 5000


def test_a_start_takes_the_load_as_zero() -> None:
    host = Host(zero_at_start=True)
    host.ask(0x200, START)
    for _ in range(20):
        assert abs(struct.unpack("<3hH", host.receive(0x600))[0]) <= 1
    host.load = host.load * 0.0
    host.force_x(lambda x: x < -1600)
    host.dismantle()


def test_the_board_sends_on_when_its_sensor_has_stopped(host: Host) -> None:
    host.ask(0x200, START)
    host.receive(0x680)
    host.node.frozen = True
    host.ask(0x400)
    counters = {struct.unpack("<3hH", host.receive(0x600))[3] for _ in range(20)}
    assert len(counters) == 1


def test_a_short_start_floods_the_bus_unfiltered(host: Host) -> None:
    host.ask(0x200, b"\x01\x00")
    assert host.node._cutoff_hz == 0.01
    assert host.node._period_s < 1e-4
    host.ask(0x200)
    assert host.node._cutoff_hz == 0.0


def test_without_a_sensor_scales_are_junk_and_a_reset_ends_it() -> None:
    host = Host(sensor=False)
    assert host.ask(0x400) == b"\x01"  # and no BOOTUP before it
    assert host.ask(0x480)[0] == 1
    assert host.ask(0x480)[1:] != struct.pack("<3H", *FULL_SCALES[:3])
    host.send(0x580)
    host.send(0x400)
    host.node.stop()
    assert host.bus.recv(0.0) is None
    host.bus.shutdown()
