"""The JR3 driver against a board that reproduces the firmware's traps, and misbehaves."""

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hardware import jr3
from hardware.interface import DeviceConfigurationError, DeviceError, FloatArray
from hardware.jr3 import FULL_SCALE, SATURATED, Jr3, Jr3Settings
from hardware.registry import force_sensor, force_sensors
from tests.fakes.jr3_node import FULL_SCALES, Frames, Jr3Node

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
LOAD = np.array([10.0, -5.0, 20.0, 0.5, 1.0, -0.25])  # N, N·m
ONE_UNIT = 0.02  # more than one raw unit, in N and in N·m
_channels = (f"jr3-{number}" for number in itertools.count())


def settings(**changes: Any) -> Jr3Settings:
    values: dict[str, Any] = {
        "interface": "virtual",
        "channel": "unused",
        "node": 1,
        "mounting": "base",
        "rotation": IDENTITY,
        "cutoff_hz": 655.0,
        "tare_samples": 5,
        "stale_after_s": 0.5,
    }
    return Jr3Settings(**values | changes)


class Wire:
    """A sensor and its board on one virtual bus."""

    def __init__(self, changes: dict[str, Any] | None = None, **board: Any) -> None:
        self.channel = next(_channels)
        self.load: FloatArray = np.zeros(6)
        bus = can.Bus(interface="virtual", channel=self.channel)
        self.node = Jr3Node(bus, wrench=lambda _: self.load, **board)
        self.held_ns: int | None = None
        self.sensor = Jr3(settings(channel=self.channel, **changes or {}), self.now_ns)
        self.node.start()

    def now_ns(self) -> int:
        return time.monotonic_ns() if self.held_ns is None else self.held_ns

    def dismantle(self) -> None:
        self.sensor.close()
        self.node.stop()

    def settles_at(self, wrench: FloatArray) -> bool:
        return bool(np.abs(self.sensor.read().wrench - wrench).max() < ONE_UNIT)

    def reads_on(self, readings: int = 5) -> None:
        """Require so many further readings."""
        for _ in range(readings):
            stamp_ns = self.sensor.read().stamp_ns
            eventually(lambda: self.sensor.read().stamp_ns > stamp_ns)  # noqa: B023

    def failure(self) -> str:
        """Wait until reading fails, and say how."""
        found: list[str] = []

        def failed() -> bool:
            try:
                self.sensor.read()
            except DeviceError as error:
                found.append(str(error))
            return bool(found)

        eventually(failed)
        return found[0]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jr3, "_SETTLE_S", 0.01)


@pytest.fixture
def build() -> Iterator[Callable[..., Wire]]:
    wires: list[Wire] = []

    def build(changes: dict[str, Any] | None = None, **board: Any) -> Wire:
        wires.append(Wire(changes, **board))
        return wires[-1]

    yield build
    for wire in wires:
        wire.dismantle()


@pytest.fixture
def wire(build: Callable[..., Wire]) -> Wire:
    wire = build()
    wire.sensor.open()
    return wire


def eventually(condition: Callable[[], bool]) -> None:
    limit_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < limit_s, "in vain"
        time.sleep(0.001)


# Start-up


def test_the_sensor_is_found_by_name() -> None:
    assert "jr3" in force_sensors()
    assert force_sensor("jr3").settings is Jr3Settings


def test_python_can_is_loaded_when_the_bus_is_opened_and_no_sooner() -> None:
    program = (
        "import sys; from hardware.registry import force_sensor; from hardware.jr3 import Jr3\n"
        "entry = force_sensor('jr3')\n"
        "sys.exit('can' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60, cwd=ROOT)


def test_start_up_asks_before_it_starts_and_never_uses_the_firmwares_zero(wire: Wire) -> None:
    assert wire.node.requests == [
        *("get_state", "stop", "start_async", "force_scales", "get_state", "moment_scales")
    ]
    wire.sensor.tare()
    wire.sensor.close()
    eventually(lambda: wire.node.requests[-1] == "stop")
    assert not {"zero", "reset"} & set(wire.node.requests)


def test_period_and_cut_off_reach_the_sensor(build: Callable[..., Wire]) -> None:
    wire = build({"period_s": 0.005, "cutoff_hz": 2.5})
    wire.sensor._initialise = lambda: wire.sensor._start()  # type: ignore[method-assign]
    wire.sensor.open()
    assert wire.node._period_s == pytest.approx(0.005)
    assert wire.node._cutoff_hz == pytest.approx(2.5)


def test_the_filter_is_waited_for_before_the_zero_is_taken(build: Callable[..., Wire]) -> None:
    # The board's filter starts at nothing: after two of its time constants it would show 86 %.
    wire = build({"cutoff_hz": 10.0}, zero_at_start=False)
    wire.load = LOAD
    wire.sensor.open()
    assert np.abs(wire.sensor.read().wrench).max() < 0.02 * LOAD.max()


@pytest.mark.parametrize("zero_at_start", [False, True])
def test_full_scales_are_the_sensors_own(build: Callable[..., Wire], zero_at_start: bool) -> None:
    wire = build(zero_at_start=zero_at_start)
    wire.sensor.open()
    wire.load = np.array(FULL_SCALES) * [0.5, 0.5, 0.5, 0.05, 0.05, 0.05]
    eventually(lambda: wire.settles_at(wire.load))


def test_a_board_that_boots_while_it_is_started_is_started_again(
    build: Callable[..., Wire],
) -> None:
    wire = build()
    answer, boots = wire.node._answer, [1]

    def answer_then_boot(message: can.Message) -> None:
        answer(message)
        if wire.node.requests[-1] == "moment_scales" and boots:
            boots.pop()
            wire.node.restart()

    wire.node._answer = answer_then_boot  # type: ignore[method-assign]
    wire.load = LOAD
    wire.sensor.open()
    assert wire.node.requests.count("start_async") == 2
    assert wire.settles_at(np.zeros(6))


def test_a_board_that_keeps_booting_is_given_up(build: Callable[..., Wire]) -> None:
    wire = build()
    answer = wire.node._answer

    def answer_then_boot(message: can.Message) -> None:
        answer(message)
        if wire.node.requests[-1] == "moment_scales":
            wire.node.restart()

    wire.node._answer = answer_then_boot  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="restarted 3 times"):
        wire.sensor.open()


def test_a_sensor_left_streaming_by_another_process_is_taken_over(
    build: Callable[..., Wire],
) -> None:
    wire = build({"stale_after_s": 0.2})
    first = Jr3(settings(channel=wire.channel), time.monotonic_ns)
    first.open()
    # Nobody said stop, and its counter is far ahead of what a new start gives.
    wire.node._started_s -= 3.0
    wire.node.ack_delay_s = 0.02
    wire.sensor.open()
    wire.reads_on()
    first.close()


def test_without_a_sensor_its_board_is_refused_and_its_junk_not_believed(
    build: Callable[..., Wire],
) -> None:
    wire = build(sensor=False)
    with pytest.raises(DeviceError, match=r"not ready \(state 1\): no sensor is plugged"):
        wire.sensor.open()
    assert wire.node.requests == ["get_state"]


def test_full_scales_are_not_believed_when_the_sensor_is_lost_while_they_are_asked(
    build: Callable[..., Wire],
) -> None:
    wire = build()
    answer = wire.node._answer

    def lose_the_sensor(message: can.Message) -> None:
        wire.node.sensor = "start_async" not in wire.node.requests
        answer(message)

    wire.node._answer = lose_the_sensor  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="not ready"):
        wire.sensor.open()


def test_full_scales_of_nothing_are_refused(
    build: Callable[..., Wire], monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = build()
    monkeypatch.setattr(wire.node, "_scales", lambda: (115, 0, 185, 56, 52, 61))
    with pytest.raises(DeviceError, match=r"full scales are \(115, 0, 185\)"):
        wire.sensor.open()


@pytest.mark.parametrize(
    ("firmware", "opcode"), [("scales_as_data", "0x580"), ("ack_0x180", "0x180")]
)
def test_older_firmware_is_refused_by_name_before_it_is_asked_anything_it_would_misread(
    build: Callable[..., Wire], firmware: str, opcode: str
) -> None:
    wire = build(firmware=firmware)
    with pytest.raises(DeviceError, match=f"firmware is too old.*{opcode}.*jr3-mbed-firmware-can"):
        wire.sensor.open()
    wire.sensor.close()
    # STOP, 0x280, is a start without a period there, which floods the bus.
    wire.node.stop()
    assert len(wire.node.requests) == 1
    assert not wire.node._streaming


@pytest.mark.parametrize("lost", range(6))
def test_a_lost_acknowledgement_is_named_and_leaves_nothing_running(
    build: Callable[..., Wire], lost: int
) -> None:
    wire = build()
    answer = wire.node._answer
    names = ["GET_STATE", "STOP", "START_ASYNC", "GET_FORCE_SCALES", "GET_STATE"]
    names.append("GET_MOMENT_SCALES")

    def lose_one(message: can.Message) -> None:
        wire.node.lose_acks = len(wire.node.requests) == lost
        answer(message)

    wire.node._answer = lose_one  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=f"does not answer {names[lost]} within 0.25 s"):
        wire.sensor.open()
    wire.node._answer = answer  # type: ignore[method-assign]
    wire.sensor.open()
    wire.reads_on()


def test_a_late_acknowledgement_is_not_taken_for_the_answer_to_another_question(
    build: Callable[..., Wire],
) -> None:
    wire = build()
    wire.node.ack_delay_s = 0.4
    with pytest.raises(DeviceError, match="does not answer GET_STATE"):
        wire.sensor.open()
    wire.node.ack_delay_s = 0.0  # from now on; the late one still comes
    wire.sensor.open()
    wire.load = LOAD
    eventually(lambda: wire.settles_at(LOAD))


def test_doubled_acknowledgements_do_not_mix_up_the_full_scales(
    build: Callable[..., Wire],
) -> None:
    wire = build()
    wire.node.double_acks = True
    wire.sensor.open()
    wire.load = LOAD
    eventually(lambda: wire.settles_at(LOAD))


def test_a_slow_board_is_waited_for(build: Callable[..., Wire]) -> None:
    wire = build()
    wire.node.ack_delay_s = 0.05
    wire.sensor.open()
    wire.reads_on()


def test_a_saturated_sensor_is_not_tared(build: Callable[..., Wire]) -> None:
    wire = build(zero_at_start=False)
    wire.load = np.array([0.0, 0.0, 200.0, 0.0, 0.0, 0.0])
    with pytest.raises(DeviceError, match=r"saturated .* unload it"):
        wire.sensor.open()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"interface": "no_such"}, "interface 'no_such' does not open"),
        ({"interface": "socketcan", "channel": "nocan7"}, "ip link set nocan7 up type can bitrate"),
    ],
)
def test_a_bus_that_does_not_open_is_explained(changes: dict[str, Any], message: str) -> None:
    sensor = Jr3(settings(**changes), time.monotonic_ns)
    with pytest.raises(DeviceError, match=message):
        sensor.open()
    sensor.close()


def test_multicast_stays_on_the_machine_and_is_classic_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: dict[str, Any] = {}

    def bus(**options: Any) -> None:
        asked.update(options)
        raise can.CanInitializationError("enough")

    monkeypatch.setattr(can, "Bus", bus)
    for interface, expected in (
        ("udp_multicast", {"fd": False, "hop_limit": 0}),
        ("socketcan", {"fd": None, "hop_limit": None}),
    ):
        asked.clear()
        with pytest.raises(DeviceError, match="enough"):
            Jr3(settings(interface=interface, bitrate=500_000), time.monotonic_ns).open()
        assert {key: asked.get(key) for key in expected} == expected
        assert (asked["interface"], asked["bitrate"]) == (interface, 500_000)


# Readings


def test_rotation_turns_force_and_moment(build: Callable[..., Wire]) -> None:
    wire = build({"rotation": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))})
    wire.sensor.open()
    wire.load = LOAD
    x, y, z, mx, my, mz = LOAD
    eventually(lambda: wire.settles_at(np.array([-y, x, z, -my, mx, mz])))


def test_the_negative_of_a_rotation_turns_the_sign(build: Callable[..., Wire]) -> None:
    wire = build({"rotation": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))})
    wire.sensor.open()
    wire.load = LOAD
    eventually(lambda: wire.settles_at(-LOAD))


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
def test_saturation_is_reported_and_is_no_fault(wire: Wire, axis: int, sign: int) -> None:
    scale = np.array(FULL_SCALES) * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
    wire.load = np.zeros(6)
    wire.load[axis] = sign * scale[axis] * (SATURATED - 100) / FULL_SCALE
    eventually(lambda: wire.settles_at(wire.load))
    assert not wire.sensor.read().saturated
    wire.load = np.zeros(6)
    wire.load[axis] = sign * scale[axis] * 1.5
    eventually(lambda: wire.sensor.read().saturated)
    wire.load = np.zeros(6)
    eventually(lambda: not wire.sensor.read().saturated)


def moments_first(pair: Frames) -> Frames:
    return pair[::-1]


def doubled(pair: Frames) -> Frames:
    return [frame for frame in pair for _ in range(2)]


class DropEveryThirdForce:
    def __init__(self) -> None:
        self.pairs = 0

    def __call__(self, pair: Frames) -> Frames:
        self.pairs += 1
        return pair[1:] if self.pairs % 3 == 0 else pair


class Late:
    """The moments of a pair come after the forces of the next; each pair again, much later."""

    def __init__(self) -> None:
        self.held: Frames = []
        self.old: Frames = []

    def __call__(self, pair: Frames) -> Frames:
        sent = [pair[0], *self.held] if len(self.old) % 4 else pair
        self.held = [pair[1]] if len(self.old) % 4 else []
        self.old += pair
        return sent + self.old[-20:-18]


@pytest.mark.parametrize("mangle", [moments_first, doubled, DropEveryThirdForce(), Late()])
def test_force_and_moment_of_one_reading_are_of_one_sample(
    wire: Wire, mangle: Callable[[Frames], Frames]
) -> None:
    # Force and moment swing together: a force of one sample and a moment of another would show.
    wire.sensor.close()
    wire.node._zero_at_start = False
    wire.sensor.open()
    swing = np.array([20.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    wire.node.wrench = lambda now_s: np.sin(2.0 * np.pi * 20.0 * now_s) * swing
    wire.node.mangle = mangle
    samples = []
    for _ in range(60):
        wire.reads_on(1)
        samples.append(wire.sensor.read().wrench)
    force, moment = np.array(samples)[:, 0], np.array(samples)[:, 3]
    force, moment = force - force.mean(), moment - moment.mean()
    assert np.ptp(force) > 20.0
    np.testing.assert_allclose(moment, force / 20.0, atol=0.004)


def test_an_old_pair_does_not_replace_a_newer_one(wire: Wire) -> None:
    held: list[Frames] = []

    def send_old(pair: Frames) -> Frames:
        held.append(pair)
        return pair if len(held) <= 3 else held[len(held) % 2]

    wire.held_ns = time.monotonic_ns()
    wire.node.mangle = send_old
    eventually(lambda: len(held) > 10)
    wire.held_ns += 1  # what is accepted from here on has a new stamp
    eventually(lambda: len(held) > 30)
    assert wire.sensor.read().stamp_ns < wire.held_ns


def test_the_counter_may_wrap(wire: Wire) -> None:
    wire.sensor.close()
    wire.sensor.open()
    wire.node._started_s -= (65_536 - wire.node._samples - 200) * 128.5e-6
    eventually(lambda: wire.node._samples > 65_536 + 200)
    wire.reads_on()


# Faults in mid-run


def test_a_counter_that_stands_still_is_stale_though_frames_come(wire: Wire) -> None:
    pairs = wire.node.pairs
    wire.node.frozen = True
    failure = wire.failure()
    assert "no new force for 0.5 s: its board sends, but not a pair with a new counter" in failure
    assert wire.node.pairs > pairs


def test_silence_is_stale(wire: Wire) -> None:
    wire.node.mute = True
    assert "no new force for 0.5 s: no frames come" in wire.failure()


@pytest.mark.parametrize("missing", [0, 1])
def test_forces_without_moments_are_stale_and_the_reverse(wire: Wire, missing: int) -> None:
    wire.node.mangle = lambda pair: [pair[1 - missing]]
    assert "not a pair with a new counter" in wire.failure()


def test_stale_is_to_the_nanosecond(wire: Wire) -> None:
    wire.node.mute = True
    wire.held_ns = time.monotonic_ns()
    last_ns = -1
    while last_ns != (last_ns := wire.sensor.read().stamp_ns):  # what was under way has arrived
        time.sleep(0.02)
    wire.held_ns = last_ns + 500_000_000
    assert wire.sensor.read().stamp_ns == last_ns
    wire.held_ns += 1
    with pytest.raises(DeviceError, match="no new force"):
        wire.sensor.read()


def test_a_board_that_boots_in_mid_run_is_a_fault_that_reopening_heals(wire: Wire) -> None:
    wire.load = LOAD
    eventually(lambda: wire.settles_at(LOAD))
    wire.node.restart()
    assert "has restarted, and its zero is lost" in wire.failure()
    wire.load = np.zeros(6)
    wire.sensor.close()
    wire.sensor.open()
    wire.load = LOAD
    eventually(lambda: wire.settles_at(LOAD))


@pytest.mark.parametrize(
    ("error_class", "name"),
    [
        (0x40, "bus off"),
        (0x04, "controller problem"),
        (0x88, "protocol violation, bus error"),
        (0x200, "unknown"),
    ],
)
def test_error_frames_are_faults_that_name_the_error(
    wire: Wire, error_class: int, name: str
) -> None:
    assert wire.sensor._bus is not None
    if error_class == 0x200:  # filtered out by python-can, but not in the kernel
        wire.sensor._bus.set_filters(None)
    wire.node.error_frame(error_class)
    assert f"error on the CAN bus: {name} ({error_class:#x})" in wire.failure()


def test_the_first_cause_is_the_one_told(wire: Wire) -> None:
    wire.node.error_frame(0x40)
    assert "bus off" in wire.failure()
    wire.node.garbage(0x600, b"")
    wire.node.restart()
    sent_ns = time.monotonic_ns()
    wire.node.garbage(0x600, bytes(8))
    eventually(lambda: wire.sensor._frame_ns > sent_ns)  # the reader has come as far
    assert "bus off" in wire.failure()


def test_lost_arbitration_is_a_busy_bus_and_no_fault(wire: Wire) -> None:
    wire.node.error_frame(0x02)
    wire.reads_on()


@pytest.mark.parametrize(
    ("opcode", "data", "words"),
    [
        (0x600, b"", "0x601 has 0 bytes, not 8"),
        (0x680, b"\xff" * 7, "0x681 has 7 bytes, not 8"),
        (0x100, b"\x00\x00", "acknowledgement has 2 bytes"),
        (0x180, b"\x00", "firmware is too old"),
    ],
)
def test_garbage_is_a_fault(wire: Wire, opcode: int, data: bytes, words: str) -> None:
    wire.node.garbage(opcode, data)
    assert words in wire.failure()


@pytest.mark.parametrize(
    "frame",
    [
        can.Message(arbitration_id=0x602, is_extended_id=False, data=b"x"),  # another node
        can.Message(arbitration_id=0x101, is_extended_id=True, data=b"xx"),
        can.Message(arbitration_id=0x601, is_extended_id=False, is_remote_frame=True),
        can.Message(arbitration_id=0x080, is_extended_id=False),  # SYNC
        can.Message(arbitration_id=0x101, is_extended_id=False, data=b"\x00"),  # nobody has asked
        can.Message(arbitration_id=0x701, is_extended_id=False, data=b"\x05"),  # a heartbeat
        can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x01\x00"),  # a request
    ],
    ids=lambda frame: str(frame).split("ID:")[1].strip(),
)
def test_what_is_not_the_sensors_is_left_alone(wire: Wire, frame: can.Message) -> None:
    other = can.Bus(interface="virtual", channel=wire.channel)
    other.send(frame)
    other.shutdown()
    wire.reads_on()


def test_a_bus_that_fails_is_a_fault(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    assert wire.sensor._bus is not None

    def recv(timeout: float | None = None) -> None:
        raise can.CanOperationError("the adapter is gone")

    monkeypatch.setattr(wire.sensor._bus, "recv", recv)
    assert "the CAN bus failed: the adapter is gone" in wire.failure()


# Between processes


def test_a_board_in_a_process_of_its_own() -> None:
    group, number = "239.74.163.2", 1 + (os.getpid() + 63) % 127
    try:
        can.Bus(interface="udp_multicast", channel=group, fd=False, hop_limit=0).shutdown()
    except (can.CanError, OSError) as error:
        pytest.skip(f"no IPv4 multicast on this machine: {error}")
    command = [sys.executable, "-m", "tests.fakes.jr3_node", "--node", str(number)]
    sensor = Jr3(settings(interface="udp_multicast", channel=group, node=number), time.monotonic_ns)
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            sensor.open()
            first = sensor.read()
            eventually(lambda: sensor.read().stamp_ns > first.stamp_ns)
            process.kill()
            with pytest.raises(DeviceError, match="no frames come"):  # noqa: PT012
                while True:
                    sensor.read()
        finally:
            sensor.close()
            process.kill()


def test_a_plant_s_wrench_is_what_its_file_says(tmp_path: Path) -> None:
    import struct

    from tests.fakes.jr3_node import plant_wrench

    image = bytearray(4096)
    struct.pack_into("<QQ", image, 0, 0x46485046414B4531, 2)
    struct.pack_into("<6d", image, 288, *LOAD)
    path = tmp_path / "plant"
    path.write_bytes(image)
    np.testing.assert_array_equal(plant_wrench(str(path))(0.0), LOAD)
    path.write_bytes(bytes(4096))
    with pytest.raises(ValueError, match="not the file of a plant"):
        plant_wrench(str(path))


# Settings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"node": 0}, "node is 0; choose between 1 and 127"),
        ({"node": 128}, "node is 128"),
        ({"bitrate": 0}, "bitrate is 0"),
        ({"cutoff_hz": 0.0}, r"cutoff_hz is 0.0; choose between 0.1 and 655.35"),
        ({"cutoff_hz": 700.0}, "cutoff_hz is 700.0"),
        ({"period_s": 0.0}, "period_s is 0.0"),
        ({"period_s": 0.01, "stale_after_s": 0.02}, r"stale_after_s is 0.02; choose between 0.03"),
        ({"tare_samples": 0}, "tare_samples is 0"),
        ({"rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))}, "perpendicular"),
        ({"rotation": ((2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0))}, "unit vectors"),
        ({"rotation": ((np.nan, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "unit vectors"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DeviceConfigurationError, match=message):
        settings(**changes)
