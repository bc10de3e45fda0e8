"""The PHANToM's servo loop, in a process of its own: `python -m hardware.phantom_servo`.

A callback of the vendor's 1 kHz scheduler copies state out to, and torque in from, two records in
shared memory; nothing else happens there. The process ends, at zero torque, when its standard input
does: however the site dies, the kernel closes the other end.
"""

import contextlib
import gc
import json
import math
import mmap
import os
import signal
import struct
import sys
import time
from ctypes import c_double, c_int32
from dataclasses import asdict, dataclass
from typing import Any, Final

from hardware.hdapi import (
    HD_CALIBRATION_ENCODER_RESET,
    HD_CALIBRATION_OK,
    HD_CALLBACK_CONTINUE,
    HD_CALLBACK_DONE,
    HD_CURRENT_BUTTONS,
    HD_CURRENT_JOINT_ANGLES,
    HD_CURRENT_JOINT_TORQUE,
    HD_CURRENT_POSITION,
    HD_FORCE_OUTPUT,
    HD_INVALID_HANDLE,
    HD_MAX_SCHEDULER_PRIORITY,
    Callback,
    HdapiError,
    load_hdapi,
    pop_errors,
)

# No arm turns so fast; encoders that say so are not to be believed.
IMPOSSIBLE_RAD_S: Final = 100.0
IMPOSSIBLE_STEP_RAD: Final = 0.05
_FAREWELL_S: Final = 0.1

STARTING, RUNNING, FAULT = 0, 1, 2


class SharedRecord:
    """A few numbers that one process writes whole and others read whole, never waiting.

    A sequence lock: odd while being written. It relies on the order of stores that x86 keeps, the
    only processors that OpenHaptics runs on.
    """

    def __init__(self, memory: memoryview, layout: str) -> None:
        self._sequence = memory[:8].cast("Q")
        self._memory = memory[8:]
        self._layout = struct.Struct(layout)
        self._last: tuple[Any, ...] = self._layout.unpack_from(self._memory)

    def put(self, *values: float) -> None:
        """Write all values."""
        writing = self._sequence[0] | 1
        self._sequence[0] = writing
        self._layout.pack_into(self._memory, 0, *values)
        self._sequence[0] = writing + 1

    def get(self) -> tuple[Any, ...]:
        """Return the newest values; the ones before, while new ones are being written."""
        for _ in range(3):
            before = self._sequence[0]
            if not before & 1:
                values = self._layout.unpack_from(self._memory)
                if self._sequence[0] == before:
                    self._last = values
                    break
        return self._last


class ServoMemory:
    """What site and servo share.

    `command`: stamp [ns] or 0, number of the enabling it belongs to or 0 for outputs off, encoder
    resets asked for, torques of thigh and shin [N·m]. `state`: stamp [ns], number of the enabling
    in force, encoder resets done, whether calibrated, bits of the buttons that are down, joint
    angles (3) [rad], position (3) [mm].
    `phase` is STARTING, RUNNING or FAULT, `text` who the device is or why it failed.
    """

    SIZE: Final = 1024

    def __init__(self, memory: mmap.mmap) -> None:
        view = memoryview(memory)
        self.command = SharedRecord(view[:256], "qQQ2d")
        self.state = SharedRecord(view[256:512], "qQQQq3d3d")
        self._phase = view[512:520].cast("Q")
        self._text = view[520:]

    @property
    def phase(self) -> int:
        """How far the servo process is."""
        return self._phase[0]

    @property
    def text(self) -> str:
        """What it says of itself."""
        return bytes(self._text).rstrip(b"\0").decode(errors="replace")

    def say(self, phase: int, text: str) -> None:
        """Set the text, then the phase."""
        data = text.encode()[: len(self._text)]
        self._text[: len(data)] = data
        self._phase[0] = phase


@dataclass(frozen=True, slots=True)
class ServoOptions:
    """What the site tells its servo process; torque limits of thigh and shin.

    `buttons` says whether the device has any. `priority` is of SCHED_FIFO, 0 for ordinary
    scheduling.
    """

    library: str
    device_name: str
    torque_limit_nm: tuple[float, float]
    timeout_s: float
    buttons: bool = False
    priority: int = 0

    def to_json(self) -> str:
        """Return the options for a command line."""
        return json.dumps(asdict(self))


class Servo:
    """The vendor's device and scheduler, and the callback between them and the shared memory."""

    def __init__(self, options: ServoOptions, memory: ServoMemory) -> None:
        self._limits_mnm = tuple(1e3 * limit for limit in options.torque_limit_nm)
        self._timeout_ns = round(options.timeout_s * 1e9)
        self._options = options
        self._memory = memory
        self._angles = (c_double * 3)()
        self._position = (c_double * 3)()
        self._torque = (c_double * 3)()
        self._buttons = c_int32()
        self._outputs = 0
        self._resets = self._resetting = 0
        self._calibrated = False
        self._frame_ns = 0
        self._before: tuple[float, float] | None = None
        self._leaving = False
        self._left = False
        self._callback = Callback(self._frame)

    def start(self) -> None:
        """Load the library, take the device, start the scheduler; raises HdapiError."""
        self._hd = hd = load_hdapi(self._options.library)
        name = self._options.device_name
        self._device = hd.hdInitDevice(name.encode() if name else None)
        error = pop_errors(hd)
        if error is not None or self._device == HD_INVALID_HANDLE:
            raise HdapiError(f"device {name!r} cannot be taken: {error or 'no reason is given'}")
        self._calibrated = hd.hdCheckCalibration() == HD_CALIBRATION_OK
        self._memory.say(RUNNING, "")  # from here on the callback may say that it has failed
        self._task = hd.hdScheduleAsynchronous(self._callback, None, HD_MAX_SCHEDULER_PRIORITY)
        hd.hdStartScheduler()
        error = pop_errors(hd)
        if error is not None:
            self.stop()
            raise HdapiError(f"the scheduler does not start: {error}")

    def stop(self) -> None:
        """Send zero torque, switch the outputs off, let go of the device."""
        self._leaving = True
        deadline_s = time.monotonic() + _FAREWELL_S
        while not self._left and time.monotonic() < deadline_s:
            time.sleep(0.5e-3)
        hd = self._hd
        hd.hdStopScheduler()
        if not self._left:
            hd.hdUnschedule(self._task)
        hd.hdDisableDevice(self._device)

    def _frame(self, _: int | None) -> int:
        # An exception that left a callback would become a number, and leave the frame open.
        try:
            self._exchange()
        except BaseException as failure:
            with contextlib.suppress(BaseException):
                self._fail(f"servo callback: {type(failure).__name__}: {failure}")
        if self._leaving and self._outputs == 0:
            self._left = True
            return HD_CALLBACK_DONE
        return HD_CALLBACK_CONTINUE

    def _exchange(self) -> None:
        hd = self._hd
        now_ns = time.monotonic_ns()  # before the frame: a state is never younger than its stamp
        hd.hdBeginFrame(self._device)
        try:
            hd.hdGetDoublev(HD_CURRENT_JOINT_ANGLES, self._angles)
            hd.hdGetDoublev(HD_CURRENT_POSITION, self._position)
            if self._options.buttons:
                hd.hdGetIntegerv(HD_CURRENT_BUTTONS, self._buttons)
            error = pop_errors(hd) or self._disbelief(now_ns)
            if error is not None:
                self._fail(error)
            self._torque[1], self._torque[2] = self._torque_mnm()
            hd.hdSetDoublev(HD_CURRENT_JOINT_TORQUE, self._torque)
        finally:
            hd.hdEndFrame(self._device)
        self._memory.state.put(
            now_ns,
            self._outputs,
            self._resets,
            self._calibrated,
            self._buttons.value,
            *self._angles,
            *self._position,
        )

    def _torque_mnm(self) -> tuple[float, float]:
        """Follow the command: outputs on or off, encoders reset, torque within limits."""
        stamp_ns, outputs, resets, *torque_nm = self._memory.command.get()
        if self._leaving or self._memory.phase == FAULT:
            outputs = 0
        if outputs != self._outputs:
            (self._hd.hdEnable if outputs else self._hd.hdDisable)(HD_FORCE_OUTPUT)
            self._outputs = outputs
            return 0.0, 0.0
        if outputs == 0:
            if resets != self._resets:
                self._reset_encoders(resets)
            return 0.0, 0.0
        if stamp_ns == 0:  # nothing has been commanded since the outputs came on
            return 0.0, 0.0
        age_ns = time.monotonic_ns() - stamp_ns
        if age_ns > self._timeout_ns:
            self._fail(f"the site's command was {age_ns * 1e-6:.1f} ms old")
            self._hd.hdDisable(HD_FORCE_OUTPUT)
            self._outputs = 0
            return 0.0, 0.0
        (thigh, shin), (thigh_limit, shin_limit) = torque_nm, self._limits_mnm
        return _within(1e3 * thigh, thigh_limit), _within(1e3 * shin, shin_limit)

    def _reset_encoders(self, resets: int) -> None:
        """Reset in one frame and report it in the next, with the angles that follow from it."""
        if self._resetting == resets:
            self._resets = resets
        else:
            self._hd.hdUpdateCalibration(HD_CALIBRATION_ENCODER_RESET)
            self._calibrated = self._hd.hdCheckCalibration() == HD_CALIBRATION_OK
            self._resetting = resets
            self._before = None

    def _disbelief(self, now_ns: int) -> str | None:
        """Say what is wrong with the angles of thigh and shin; the turret's are not used."""
        thigh, shin = self._angles[1], self._angles[2]
        if not (math.isfinite(thigh) and math.isfinite(shin)):
            return f"joint angles {thigh} and {shin} rad"
        if self._before is not None:
            step = max(abs(thigh - self._before[0]), abs(shin - self._before[1]))
            elapsed_s = (now_ns - self._frame_ns) * 1e-9
            if step > IMPOSSIBLE_STEP_RAD + IMPOSSIBLE_RAD_S * elapsed_s:
                return f"joint angles jumped by {step:.3g} rad within {elapsed_s * 1e3:.2g} ms"
        self._before, self._frame_ns = (thigh, shin), now_ns
        return None

    def _fail(self, cause: str) -> None:
        """Latch the first cause; zero torque from here on."""
        self._torque[1] = self._torque[2] = 0.0
        if self._memory.phase != FAULT:
            self._memory.say(FAULT, cause)


def _within(value: float, limit: float) -> float:
    if -limit <= value <= limit:
        return value
    return math.copysign(limit, value) if math.isfinite(value) else 0.0


def main() -> None:
    """Serve the memory whose file descriptor is the first argument until standard input ends."""
    # A terminal's Ctrl-C reaches every process in it; the site ends this one in its own time.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    os.sched_setaffinity(0, range(os.cpu_count() or 1))  # not on the CPU that the loop stays on
    memory = ServoMemory(mmap.mmap(int(sys.argv[1]), ServoMemory.SIZE))
    values = json.loads(sys.argv[2])
    values["torque_limit_nm"] = tuple(values["torque_limit_nm"])
    options = ServoOptions(**values)
    if options.priority > 0:
        with contextlib.suppress(PermissionError):  # the vendor's thread inherits it
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(options.priority))
    servo = Servo(options, memory)
    gc.disable()  # the callback makes no cycles
    try:
        servo.start()
    except HdapiError as error:
        memory.say(FAULT, str(error))
        return
    try:
        os.read(0, 1)
    finally:
        servo.stop()


if __name__ == "__main__":
    main()
