"""The PHANToM driver over the stand-in for libHD: every injected fault, and what it leads to."""

import math
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hardware.phantom_process
from hardware.hdapi import ERROR_NAMES, HD_CALLBACK_CONTINUE
from hardware.interface import (
    DeviceConfigurationError,
    DeviceError,
    DeviceState,
    VelocityByDifference,
)
from hardware.phantom import PhantomDevice, PhantomSettings
from hardware.phantom_servo import FAULT, Servo, ServoMemory, ServoOptions
from hardware.registry import DeviceContext, driver
from hardware.robot_model import PlanarArm, build_robot
from tests.fakes.hd import fake_hd
from tests.fakes.hd.fake_hd import FakeHd

needs_fake = pytest.mark.skipif(fake_hd.missing() is not None, reason=fake_hd.missing() or "")
pytestmark = [needs_fake, pytest.mark.processes]

PUSH = np.array([0.03, 0.02])  # on the serial joints: 0.01 and 0.02 N·m on thigh and shin
ROOT = Path(__file__).parents[2]


class Bench:
    """The driver, ready to be opened, and the device that is not there."""

    def __init__(self, **settings: Any) -> None:
        self.fake = FakeHd()
        self.settings = replace(
            PhantomSettings(
                (0.0, 0.0),
                library=self.fake.library,
                device_name=self.fake.device_name,
                theta3="absolute",
                torque_ramp_s=0.0,
                timeout_s=0.5,
            ),
            **settings,
        )
        self.device = PhantomDevice(self.settings)

    def enable(self) -> None:
        self.device.open()
        self.device.enable()

    def push(self, ticks: int = 5) -> DeviceState:
        for _ in range(ticks):
            state = self.device.read()
            self.device.write(PUSH)
            self.fake.frames(2)
        return state

    def push_for(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.push(1)

    def failure(self) -> str:
        """Run until the device fails; the torque is zero then, and stays so."""
        with pytest.raises(DeviceError) as caught:
            self.push_for(20.0)
        self.fake.frames(2)
        assert self.fake.sent_nm == [0.0, 0.0, 0.0]
        with pytest.raises(DeviceError) as again:
            self.device.write(PUSH)
        assert str(again.value) == str(caught.value)
        with pytest.raises(DeviceError):
            self.device.enable()
        return str(caught.value)


def refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except DeviceError:
        return True
    return False


@pytest.fixture
def make() -> Iterator[Callable[..., Bench]]:
    benches = []

    def make(**settings: Any) -> Bench:
        benches.append(Bench(**settings))
        return benches[-1]

    yield make
    for bench in benches:
        bench.fake.block.hang_in_init = 0
        bench.device.close()


@pytest.fixture
def bench(make: Callable[..., Bench]) -> Bench:
    return make()


@pytest.fixture
def pushing(bench: Bench) -> Bench:
    bench.enable()
    bench.push()
    assert bench.fake.sent_nm == pytest.approx([0.0, 0.01, 0.02])
    return bench


# What the device and its library may do wrong.


@pytest.mark.parametrize("code", ERROR_NAMES)
def test_an_error_of_the_vendor_is_a_fault_that_names_it(pushing: Bench, code: int) -> None:
    pushing.fake.block.inject_error = code
    pushing.fake.frames(5)  # the servo loop does not wait for the site to see it
    assert pushing.fake.sent_nm == [0.0, 0.0, 0.0]
    assert ERROR_NAMES[code] in pushing.failure()
    pushing.fake.frames(2)
    assert not pushing.fake.block.force_output


def fail_by_heat(bench: Bench) -> None:
    bench.fake.block.warm = 1


def fail_by_unplugging(bench: Bench) -> None:
    bench.fake.block.unplugged = 1


def report(value: float) -> Callable[[Bench], None]:
    def trouble(bench: Bench) -> None:
        bench.fake.block.value[2] = value
        bench.fake.block.replace[2] = 1

    return trouble


def fail_by_jump(bench: Bench) -> None:
    bench.fake.block.jump = 1


def fail_by_speed(bench: Bench) -> None:
    bench.fake.block.hand_nm[1] = 20.0


def fail_by_stutter(bench: Bench) -> None:
    bench.fake.block.stall_ms = 1500


def fail_by_slow_servo(bench: Bench) -> None:
    bench.fake.block.period_us = 1_500_000


def fail_by_death_of_servo(bench: Bench) -> None:
    os.kill(bench.fake.block.pid, signal.SIGKILL)
    bench.fake.block.running = 0  # the stand-in cannot say so any more
    bench.fake.block.sent_mnm[:] = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("trouble", "cause"),
    [
        pytest.param(fail_by_heat, "let them cool", id="warm motors"),
        pytest.param(fail_by_unplugging, "HD_COMM_ERROR.*cable", id="unplugged"),
        pytest.param(report(math.nan), "joint angles .*nan", id="NaN"),
        pytest.param(report(math.inf), "joint angles .*inf", id="infinite"),
        pytest.param(report(40.0), "jumped by", id="nonsense"),
        pytest.param(fail_by_jump, "jumped by 1", id="encoder slip"),
        pytest.param(fail_by_speed, "HD_EXCEEDED_MAX_VELOCITY", id="too fast"),
        pytest.param(fail_by_stutter, "ms old", id="stutter"),
        pytest.param(fail_by_slow_servo, "ms old", id="slow scheduler"),
        pytest.param(fail_by_death_of_servo, "servo process has ended", id="servo killed"),
    ],
)
def test_trouble_is_a_fault_that_names_it(
    pushing: Bench, trouble: Callable[[Bench], None], cause: str
) -> None:
    trouble(pushing)
    assert re.search(cause, pushing.failure())


def test_frozen_angles_look_like_an_arm_at_rest(pushing: Bench) -> None:
    # Nothing that the vendor tells sets them apart; the torque stays within the motors' limits.
    pushing.fake.block.freeze_angles = 1
    for _ in range(100):
        state = pushing.push(1)
    np.testing.assert_allclose(state.velocity_rad_s, 0.0, atol=1e-3)


# The way from command to motor.


def test_each_motor_is_cut_to_its_own_limit_and_the_base_gets_nothing(
    make: Callable[..., Bench],
) -> None:
    bench = make(motor_torque_limit_nm=(0.1, 0.05))
    bench.enable()
    for asked, sent in (
        ((5.0, 0.02), [0.0, 0.1, 0.02]),
        ((-5.0, -5.0), [0.0, 0.0, -0.05]),
        ((-4.0, 5.0), [0.0, -0.1, 0.05]),
    ):
        bench.device.write(np.array(asked))
        bench.fake.frames(2)
        assert bench.fake.sent_nm == pytest.approx(sent)


def test_torque_ramps_in_after_every_enable(make: Callable[..., Bench]) -> None:
    bench = make(torque_ramp_s=0.4)
    bench.device.open()
    for _ in range(2):
        bench.device.enable()
        shares = []
        while not shares or shares[-1] < 1.0:
            bench.device.read()
            bench.device.write(PUSH)
            bench.fake.frames(2)
            shares.append(bench.fake.sent_nm[2] / PUSH[1])
        assert shares == sorted(shares)
        assert len([share for share in shares if share < 0.9]) > 5
        assert shares[0] < 0.5
        assert max(shares) == pytest.approx(1.0)
        bench.device.stop()


def test_a_command_that_is_not_renewed_lapses_and_stays_so(make: Callable[..., Bench]) -> None:
    bench = make(timeout_s=0.05)
    bench.enable()
    bench.device.write(np.array([0.03, 0.02]))
    bench.fake.wait(lambda: bench.fake.sent_nm != [0.0, 0.0, 0.0])
    bench.fake.wait(lambda: bench.fake.sent_nm == [0.0, 0.0, 0.0])
    bench.fake.wait(lambda: not bench.fake.block.force_output)
    with pytest.raises(DeviceError, match=r"command was .* ms old"):
        bench.device.write(PUSH)


def test_torque_lasts_no_longer_than_its_time(make: Callable[..., Bench]) -> None:
    bench = make(timeout_s=0.05)
    bench.enable()
    bench.device.write(PUSH)
    bench.fake.wait(lambda: not bench.fake.block.force_output)
    block = bench.fake.block
    sent = [entry for entry in block.log[: block.log_count] if any(entry.sent_mnm)]
    assert sent
    assert sent[-1].begin_ns - sent[0].begin_ns <= 50_000_000


def test_outputs_that_are_on_wait_for_the_first_command(make: Callable[..., Bench]) -> None:
    bench = make(timeout_s=0.05)
    bench.enable()
    bench.fake.frames(200)
    bench.push()
    assert bench.fake.sent_nm == pytest.approx([0.0, 0.01, 0.02])


def test_stop_and_close_return_with_zero_torque_sent(pushing: Bench) -> None:
    pushing.device.stop()
    assert pushing.fake.sent_nm == [0.0, 0.0, 0.0]
    assert not pushing.fake.block.force_output
    pushing.device.enable()
    pushing.push()
    assert any(pushing.fake.sent_nm)
    pushing.device.close()
    assert pushing.fake.sent_nm == [0.0, 0.0, 0.0]
    assert (pushing.fake.block.running, pushing.fake.block.open) == (0, 0)


def test_enabling_again_returns_with_zero_torque_sent(pushing: Bench) -> None:
    pushing.device.enable()
    assert pushing.fake.sent_nm == [0.0, 0.0, 0.0]
    pushing.push()
    assert any(pushing.fake.sent_nm)


def test_the_vendors_rules_are_kept(pushing: Bench) -> None:
    pushing.push(100)
    pushing.device.stop()
    pushing.device.calibrate()
    pushing.device.enable()
    pushing.push(10)
    pushing.device.close()
    block = pushing.fake.block
    assert (block.errors, block.left_open, block.bad_returns) == (0, 0, 0)


# The end of the site, whatever it is.

SITE = """
import sys, time, numpy as np
from hardware.phantom import PhantomDevice, PhantomSettings
library, name, timeout_s, ending = sys.argv[1:]
device = PhantomDevice(PhantomSettings(
    (0.0, 0.0), library=library, device_name=name, theta3="absolute", torque_ramp_s=0.0,
    timeout_s=float(timeout_s)))
device.open()
device.enable()
end_s = time.monotonic() + (0.5 if ending != "run" else 100.0)
while time.monotonic() < end_s:
    device.read()
    device.write(np.array([0.03, 0.02]))
    time.sleep(0.001)
if ending == "exception":
    raise RuntimeError("the site is broken")
"""


def site(fake: FakeHd, ending: str, timeout_s: float) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-c", SITE, fake.library, fake.device_name, str(timeout_s), ending],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    fake.wait(lambda: any(fake.sent_nm) or process.poll() is not None)
    assert any(fake.sent_nm)
    return process


@pytest.mark.parametrize("ending", ["exception", "forgotten"])
def test_a_site_that_ends_without_close_leaves_zero_torque(ending: str) -> None:
    fake = FakeHd()
    process = site(fake, ending, timeout_s=1.0)
    _, shown = process.communicate(timeout=60)
    assert ("the site is broken" in shown) == (ending == "exception")
    fake.wait(lambda: not fake.block.running)
    assert fake.sent_nm == [0.0, 0.0, 0.0]
    assert not fake.block.open


def test_a_killed_site_leaves_zero_torque_and_no_process() -> None:
    fake = FakeHd()
    process = site(fake, "run", timeout_s=1.0)
    servo = fake.block.pid
    process.kill()
    process.communicate()
    fake.wait(lambda: not fake.block.running)
    assert fake.sent_nm == [0.0, 0.0, 0.0]
    fake.wait(lambda: not Path(f"/proc/{servo}").exists())


def test_a_site_that_stands_still_loses_its_torque_and_its_device() -> None:
    fake = FakeHd()
    process = site(fake, "run", timeout_s=0.2)
    process.send_signal(signal.SIGSTOP)
    fake.wait(lambda: not any(fake.sent_nm))
    assert fake.block.running
    process.send_signal(signal.SIGCONT)
    _, shown = process.communicate(timeout=60)
    assert "command was" in shown
    assert process.returncode == 1
    fake.wait(lambda: not fake.block.running)
    assert fake.sent_nm == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("site", "servo"), [(0, 0), (10, 11), (99, 99)])
def test_the_servo_is_scheduled_above_the_site(bench: Bench, site: int, servo: int) -> None:
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    if site:
        try:  # as the site asks for it: what it starts would be ordinary again
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(site))
        except PermissionError:
            pytest.skip("SCHED_FIFO is not granted here")
    try:
        bench.device.open()
    finally:
        os.sched_setscheduler(0, *before)
    pid = bench.fake.block.pid
    threads = [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]
    assert len(threads) == 2
    for thread in threads:
        assert os.sched_getparam(thread).sched_priority == servo


def test_a_terminals_interrupt_leaves_the_servo_running(pushing: Bench) -> None:
    os.kill(pushing.fake.block.pid, signal.SIGINT)
    pushing.push(50)
    assert any(pushing.fake.sent_nm)


def test_a_servo_that_is_told_to_end_does_so_at_zero_torque(pushing: Bench) -> None:
    os.kill(pushing.fake.block.pid, signal.SIGTERM)
    assert "servo process has ended" in pushing.failure()
    assert not pushing.fake.block.running


def test_a_servo_that_stands_still_does_not_hold_up_stop(make: Callable[..., Bench]) -> None:
    bench = make(timeout_s=0.05)
    bench.enable()
    bench.push()
    os.kill(bench.fake.block.pid, signal.SIGSTOP)
    bench.fake.wait(lambda: refused(bench.device.read))
    bench.device.stop()
    os.kill(bench.fake.block.pid, signal.SIGCONT)
    bench.fake.wait(lambda: not any(bench.fake.sent_nm))
    with pytest.raises(DeviceError, match="newest reading is"):
        bench.device.read()


# Opening.


@pytest.mark.parametrize(
    ("settings", "cause"),
    [
        ({"library": "libHD_not_there.so"}, "cannot be loaded.*install OpenHaptics"),
        ({"library": "libm.so.6"}, "not OpenHaptics 3"),
    ],
)
def test_a_library_that_is_missing_or_another_s(
    make: Callable[..., Bench], settings: dict[str, str], cause: str
) -> None:
    bench = make(**settings)
    with pytest.raises(DeviceError, match=cause):
        bench.device.open()
    with pytest.raises(DeviceError, match="not open"):
        bench.device.read()


@pytest.mark.parametrize("code", [0x0300, 0x0301, 0x0303, 0x0600])
def test_a_device_that_cannot_be_taken(bench: Bench, code: int) -> None:
    bench.fake.block.init_error = code
    with pytest.raises(DeviceError, match=ERROR_NAMES[code]):
        bench.device.open()
    bench.fake.block.init_error = 0
    bench.device.open()
    bench.device.read()


def test_a_device_that_is_unplugged_before(bench: Bench) -> None:
    bench.fake.block.unplugged = 1
    with pytest.raises(DeviceError, match="HD_COMM_ERROR"):
        bench.device.open()


def test_a_library_that_never_returns(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware.phantom_process, "_START_S", 0.5)
    monkeypatch.setattr(hardware.phantom_process, "_END_S", 0.1)
    bench.fake.block.hang_in_init = 1
    with pytest.raises(DeviceError, match="did not start within"):
        bench.device.open()
    pid = bench.fake.block.pid
    assert not Path(f"/proc/{pid}").exists()


# Joint stops and the clutch button.


@pytest.mark.parametrize("relative", [0, 1])
def test_an_arm_at_its_stop_reads_a_position_on_the_bound(
    make: Callable[..., Bench], relative: int
) -> None:
    third = "relative" if relative else "absolute"
    bench = make(theta3=third, joint_offset_rad=(0.1, math.pi))
    bench.fake.block.theta3_relative = relative
    bench.fake.block.angle_rad[:] = (0.0, math.radians(40.0), math.radians(95.0))
    stops = bench.device.joint_stops
    bench.device.open()
    along = stops.matrix @ bench.device.read().position_rad
    assert along[2] == pytest.approx(stops.upper_rad[2], abs=3e-4)  # two encoders' resolution
    assert (stops.lower_rad < along).all()
    assert (along[:2] < stops.upper_rad[:2]).all()


def test_any_button_held_down_is_the_clutch(make: Callable[..., Bench]) -> None:
    bench = make(clutch_button=True)
    bench.enable()
    assert bench.push().clutch is False
    for bits in (1, 2, 4, 8, 5):
        bench.fake.block.buttons = bits
        assert bench.push().clutch is True
        bench.fake.block.buttons = 0
        assert bench.push().clutch is False
    assert bench.fake.block.errors == 0


def test_a_button_line_that_nobody_asked_for_is_not_looked_at(pushing: Bench) -> None:
    pushing.fake.block.buttons = 3
    assert pushing.push().clutch is False


# Calibration and the third angle.


def test_an_uncalibrated_device_is_not_enabled_and_says_what_to_do(bench: Bench) -> None:
    bench.fake.block.needs_calibration = 1
    bench.fake.block.angle_rad[:] = (0.1, 0.7, -0.3)
    bench.device.open()
    with pytest.raises(DeviceError, match="right angles"):
        bench.device.enable()
    bench.device.read()  # no fault: it can be calibrated
    bench.device.calibrate()
    np.testing.assert_allclose(bench.device.read().position_rad, (0.0, -0.5 * math.pi), atol=1e-3)
    np.testing.assert_array_equal(bench.device.read().velocity_rad_s, 0.0)
    bench.device.enable()
    bench.push()
    assert any(bench.fake.sent_nm)


def test_no_calibration_under_torque(pushing: Bench) -> None:
    with pytest.raises(DeviceError, match="outputs are on"):
        pushing.device.calibrate()
    assert list(pushing.fake.block.zero_rad) == [0.0, 0.0, 0.0]
    pushing.push()
    assert any(pushing.fake.sent_nm)


def test_opening_may_calibrate(make: Callable[..., Bench]) -> None:
    bench = make(calibrate_on_open=True)
    bench.fake.block.needs_calibration = 1
    bench.device.open()
    np.testing.assert_allclose(bench.device.read().position_rad, (0.0, -0.5 * math.pi), atol=1e-3)
    bench.device.enable()


@pytest.mark.parametrize("relative", [0, 1])
def test_the_third_angle_is_found_by_hand_before_outputs_come_on(
    make: Callable[..., Bench], relative: int
) -> None:
    bench = make(theta3="check")
    block = bench.fake.block
    block.theta3_relative = relative
    bench.device.open()
    with pytest.raises(DeviceError, match="move the arm by hand"):
        bench.device.enable()
    block.hand_nm[:] = (0.0, 0.06, 0.03)
    for _ in range(5000):
        state = bench.device.read()
        bench.fake.frames(1)
        if bench.device._check.found is not None:
            break
    block.hand_nm[:] = (0.0, 0.0, 0.0)
    bench.fake.frames(2)
    state = bench.device.read()
    assert bench.device._check.found == ("relative" if relative else "absolute")
    thigh, shin = block.angle_rad[1:]
    np.testing.assert_allclose(state.position_rad, (thigh, shin - thigh - 0.5 * math.pi), atol=0.05)
    bench.device.enable()
    bench.push()
    assert bench.fake.sent_nm == pytest.approx([0.0, 0.03 if relative else 0.01, 0.02])


def test_a_finding_is_not_kept_for_another_opening(make: Callable[..., Bench]) -> None:
    bench = make(theta3="check")
    bench.device.open()
    bench.device._check.found = "relative"
    bench.device.close()
    bench.device.open()
    with pytest.raises(DeviceError, match="not known yet"):
        bench.device.enable()


# Signals.


def test_velocity_is_that_of_the_arm(bench: Bench) -> None:
    bench.fake.block.hand_nm[:] = (0.0, 0.02, -0.01)
    bench.device.open()
    for _ in range(500):
        bench.fake.frames(1)
        state = bench.device.read()
    thigh, shin = bench.fake.block.velocity_rad_s[1:]
    assert abs(thigh) > 0.5
    np.testing.assert_allclose(state.velocity_rad_s, (thigh, shin - thigh), rtol=0.1)


def test_a_plant_shared_with_other_fakes_moves_and_feels_the_last_two_joints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    path = tmp_path / "plant"
    memory = bytearray(4096)
    struct.pack_into("<QQqII", memory, 0, 0x46485046414B4531, 0, 0, 4, 1)
    struct.pack_into("<4d", memory, 32, 9.0, 9.0, 0.4, 0.9)
    path.write_bytes(memory)
    monkeypatch.setenv("FARHAND_FAKE_PLANT", str(path))
    bench.enable()
    state = bench.push()
    np.testing.assert_allclose(state.position_rad, (0.4, 0.5 - 0.5 * math.pi), atol=1e-3)
    written = path.read_bytes()
    assert struct.unpack_from("<4d", written, 512) == pytest.approx((0.0, 0.0, 0.01, 0.02))
    stamps = struct.unpack_from("<4q", written, 640)
    assert stamps[:2] == (0, 0)
    assert min(stamps[2:]) > 0


# The callback by itself: a library of Python functions, which fail on demand.


class Library:
    def __init__(self, failing: str) -> None:
        self.calls: list[str] = []
        self.failing = failing

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            self.calls.append(name)
            if name == self.failing:
                raise RuntimeError(f"{name} is broken")
            return type("Info", (), {"code": 0})() if name == "hdGetError" else 0

        return call


@pytest.mark.parametrize(
    "failing",
    [
        *("hdBeginFrame", "hdGetDoublev", "hdGetIntegerv", "hdGetError"),
        *("hdSetDoublev", "hdEndFrame"),
    ],
)
def test_a_callback_never_raises_and_ends_every_frame_it_began(failing: str) -> None:
    memory = ServoMemory(memoryview(bytearray(ServoMemory.SIZE)))  # type: ignore[arg-type]
    servo = Servo(ServoOptions("", "", (0.3, 0.3), 0.01, buttons=True), memory)
    servo._hd = library = Library(failing)  # type: ignore[assignment]
    servo._device = 0
    for _ in range(2):
        assert servo._frame(None) == HD_CALLBACK_CONTINUE
    first = f"servo callback: RuntimeError: {failing} is broken"
    assert (memory.phase, memory.text) == (FAULT, first)
    begun = 0 if failing == "hdBeginFrame" else 2
    assert library.calls.count("hdEndFrame") == begun
    library.failing = "hdSetDoublev" if failing == "hdGetDoublev" else "hdGetDoublev"
    servo._frame(None)
    assert memory.text == first


def test_half_a_record_is_never_read() -> None:
    data = memoryview(bytearray(ServoMemory.SIZE))
    writer, reader = (ServoMemory(data) for _ in range(2))  # type: ignore[arg-type]
    writer.command.put(1, 2, 3, 4.0, 5.0)
    assert reader.command.get() == (1, 2, 3, 4.0, 5.0)
    writer.command._sequence[0] += 1  # killed while writing
    writer.command._layout.pack_into(writer.command._memory, 0, 9, 9, 9, 9.0, 9.0)
    assert reader.command.get() == (1, 2, 3, 4.0, 5.0)
    writer.command.put(6, 7, 8, 9.0, 10.0)
    assert reader.command.get() == (6, 7, 8, 9.0, 10.0)


# Settings.


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("joint_offset_rad", (math.nan, 0.0)),
        ("motor_torque_limit_nm", (0.0, 0.3)),
        ("motor_torque_limit_nm", (0.3, 1.446)),
        ("motor_torque_limit_nm", (0.3, math.nan)),
        ("torque_ramp_s", -0.1),
        ("timeout_s", 0.0),
        ("timeout_s", 1.1),
        ("difference_filter_s", -1e-3),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises(DeviceConfigurationError, match=key):
        PhantomSettings(**({"joint_offset_rad": (0.0, 0.0)} | {key: value}))


def test_the_driver_moves_two_joints_also_of_a_robot_of_more() -> None:
    entry = driver("phantom")
    settings = PhantomSettings((0.0, 0.0), difference_filter_s=0.002)
    assert isinstance(settings, VelocityByDifference)
    assert settings.difference_filter_s == 0.002

    def context(*lengths_m: float) -> DeviceContext:
        model = build_robot(PlanarArm("planar", lengths_m, (0.1,) * len(lengths_m)), None)
        return DeviceContext(model, None, now_ns=lambda: 0, session_start_ns=0, seed=0)

    for lengths_m in ((0.21, 0.25), (0.25, 0.14, 0.21, 0.17)):
        assert entry.create(settings, context(*lengths_m)).joints == 2
