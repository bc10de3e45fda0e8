"""The vendor's library through ctypes, and the rules that its stand-in keeps."""

import ctypes
import math
import threading
from collections.abc import Iterator

import pytest

from hardware.hdapi import (
    ERROR_NAMES,
    HD_CALLBACK_CONTINUE,
    HD_CALLBACK_DONE,
    HD_CURRENT_JOINT_ANGLES,
    HD_CURRENT_JOINT_TORQUE,
    HD_CURRENT_POSITION,
    HD_FORCE_OUTPUT,
    HD_INVALID_HANDLE,
    SIGNATURES,
    Callback,
    HdapiError,
    describe,
    load_hdapi,
    pop_errors,
)
from tests.fakes.hd import fake_hd
from tests.fakes.hd.fake_hd import FakeHd

pytestmark = pytest.mark.skipif(fake_hd.missing() is not None, reason=fake_hd.missing() or "")


class Bench:
    def __init__(self) -> None:
        self.fake = FakeHd()
        self.hd = load_hdapi(self.fake.library)
        self.device = self.hd.hdInitDevice(self.fake.device_name.encode())
        self.torque = (ctypes.c_double * 3)(0.0, 100.0, 50.0)
        self.pushed: list[str] = []

    def run_callback(self, body, code: int = HD_CALLBACK_DONE) -> None:  # type: ignore[no-untyped-def]
        """Run a callback once in the servo loop."""
        ran = threading.Event()

        def call(_: int | None) -> int:
            body()
            ran.set()
            return code

        self._kept = Callback(call)
        self.task = self.hd.hdScheduleAsynchronous(self._kept, None, 1)
        assert ran.wait(20.0)
        self.fake.wait(lambda: True)
        done = self.fake.block.log_count + 2
        self.fake.wait(lambda: self.fake.block.log_count >= done)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.hd.hdStartScheduler()
    yield bench
    if bench.fake.block.running:
        bench.hd.hdStopScheduler()
    if bench.fake.block.open:
        bench.hd.hdDisableDevice(bench.device)
    pop_errors(bench.hd)


def test_every_declared_function_is_there() -> None:
    hd = load_hdapi(FakeHd().library)
    assert all(hasattr(hd, name) for name in SIGNATURES)
    assert len(SIGNATURES) == 36


def test_a_missing_library_says_how_to_get_it() -> None:
    with pytest.raises(HdapiError, match="install OpenHaptics"):
        load_hdapi("libHD_that_is_not_there.so")


def test_another_library_is_refused() -> None:
    with pytest.raises(HdapiError, match="is not OpenHaptics 3: it has no hd"):
        load_hdapi("libm.so.6")


@pytest.mark.parametrize("code", ERROR_NAMES)
def test_errors_have_names(code: int) -> None:
    assert describe(code, 7).startswith(f"{ERROR_NAMES[code]} (0x{code:04x}, internal 7)")


def test_an_unknown_error_is_shown_by_number() -> None:
    assert "0x0999" in describe(0x0999, 0)


def errors(bench: Bench) -> str:
    return pop_errors(bench.hd) or ""


def test_the_oldest_error_is_told_and_the_stack_left_empty(bench: Bench) -> None:
    bench.hd.hdEndFrame(bench.device)  # ILLEGAL_END
    bench.hd.hdEnable(1)  # INVALID_ENUM
    assert "HD_ILLEGAL_END" in errors(bench)
    assert pop_errors(bench.hd) is None


def test_a_force_error_is_told_before_an_older_one(bench: Bench) -> None:
    bench.hd.hdEnable(1)
    bench.fake.block.inject_error = 0x0200
    bench.run_callback(lambda: frame(bench))
    bench.hd.hdEnable(1)
    assert "HD_WARM_MOTORS" in errors(bench)


def frame(bench: Bench, torque: bool = False) -> None:
    bench.hd.hdBeginFrame(bench.device)
    if torque:
        bench.hd.hdSetDoublev(HD_CURRENT_JOINT_TORQUE, bench.torque)
    bench.hd.hdEndFrame(bench.device)


def test_torque_leaves_at_the_end_of_a_frame_and_with_force_output_only(bench: Bench) -> None:
    bench.run_callback(lambda: frame(bench, torque=True))
    assert bench.fake.sent_nm == [0.0, 0.0, 0.0]
    bench.run_callback(lambda: (bench.hd.hdEnable(HD_FORCE_OUTPUT), frame(bench, torque=True)))
    assert bench.fake.sent_nm == pytest.approx([0.0, 0.1, 0.05])
    assert errors(bench) == ""


def test_a_frame_begins_with_no_torque(bench: Bench) -> None:
    bench.run_callback(lambda: (bench.hd.hdEnable(HD_FORCE_OUTPUT), frame(bench, torque=True)))
    bench.run_callback(lambda: frame(bench))
    assert bench.fake.sent_nm == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("calls", "name"),
    [
        (("hdBeginFrame", "hdBeginFrame", "hdEndFrame"), "HD_ILLEGAL_BEGIN"),
        (("hdBeginFrame", "hdEndFrame") * 2, "HD_ILLEGAL_BEGIN"),
        (("hdEndFrame",), "HD_ILLEGAL_END"),
        (("hdBeginFrame",), "HD_FRAME_ERROR"),
    ],
)
def test_frames_come_in_pairs_one_a_tick(bench: Bench, calls: tuple[str, ...], name: str) -> None:
    bench.run_callback(lambda: [getattr(bench.hd, call)(bench.device) for call in calls])
    assert name in errors(bench)


def test_a_callback_that_returns_garbage_is_not_called_again(bench: Bench) -> None:
    calls = []
    bench.run_callback(lambda: calls.append(0), code=1342365200)
    assert (len(calls), bench.fake.block.bad_returns) == (1, 1)
    assert not bench.hd.hdWaitForCompletion(bench.task, 0)


def test_a_callback_that_continues_is_called_every_tick_until_unscheduled(bench: Bench) -> None:
    calls = []
    bench.run_callback(lambda: calls.append(0), code=HD_CALLBACK_CONTINUE)
    assert len(calls) > 1
    bench.hd.hdUnschedule(bench.task)
    bench.hd.hdWaitForCompletion(bench.task, 1)
    count, ticks = len(calls), bench.fake.block.log_count
    bench.fake.wait(lambda: bench.fake.block.log_count > ticks + 3)
    assert len(calls) == count


def test_a_device_is_taken_once(bench: Bench) -> None:
    assert bench.hd.hdInitDevice(None) == HD_INVALID_HANDLE
    assert "HD_DEVICE_ALREADY_INITIATED" in errors(bench)


@pytest.mark.parametrize("relative", [0, 1])
def test_position_is_that_of_an_unmodified_arm_in_mm(bench: Bench, relative: int) -> None:
    bench.fake.block.theta3_relative = relative
    angles, position = (ctypes.c_double * 3)(), (ctypes.c_double * 3)()
    heights = []
    for thigh, shin in ((0.2, 0.3), (0.5, 0.9)):
        bench.fake.block.angle_rad[:] = (0.0, thigh, shin)

        def look() -> None:
            bench.hd.hdBeginFrame(bench.device)
            bench.hd.hdGetDoublev(HD_CURRENT_JOINT_ANGLES, angles)
            bench.hd.hdGetDoublev(HD_CURRENT_POSITION, position)
            bench.hd.hdEndFrame(bench.device)

        bench.run_callback(look)
        assert angles[2] == pytest.approx(shin - relative * thigh, abs=3e-4)
        heights.append(position[1] - 1e3 * (0.2096 * math.sin(thigh) - 0.1695 * math.cos(shin)))
    assert heights[0] == pytest.approx(heights[1], abs=0.2)


def test_the_encoders_are_not_reset_with_force_output_on(bench: Bench) -> None:
    bench.run_callback(
        lambda: (bench.hd.hdEnable(HD_FORCE_OUTPUT), bench.hd.hdUpdateCalibration(1))
    )
    assert "HD_INVALID_OPERATION" in errors(bench)
    assert list(bench.fake.block.zero_rad) == [0.0, 0.0, 0.0]


def test_integers_are_not_asked_for_as_doubles(bench: Bench) -> None:
    bench.run_callback(lambda: bench.hd.hdGetDoublev(0x2000, bench.torque))
    assert "HD_INVALID_INPUT_TYPE" in errors(bench)
