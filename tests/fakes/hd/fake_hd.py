"""The stand-in for OpenHaptics: builds fake_hd.c, watches it, makes it misbehave."""

import ctypes
import hashlib
import mmap
import os
import shutil
import subprocess
import tempfile
import time
import weakref
from collections.abc import Callable
from pathlib import Path

SOURCE = Path(__file__).with_name("fake_hd.c")
LOG = 65536

_I32, _I64, _U64, _F64 = ctypes.c_int32, ctypes.c_int64, ctypes.c_uint64, ctypes.c_double


class LogEntry(ctypes.Structure):
    """One tick of the scheduler: due, callbacks begun and ended, frame begun, torque sent."""

    _fields_ = (
        ("due_ns", _I64),
        ("start_ns", _I64),
        ("end_ns", _I64),
        ("begin_ns", _I64),
        ("sent_mnm", _F64 * 3),
    )


class Block(ctypes.Structure):
    """`struct block` of fake_hd.c."""

    _fields_ = (
        *((name, _I32) for name in ("inject_error", "init_error", "unplugged", "freeze_angles")),
        *((name, _I32) for name in ("stall_ms", "period_us", "warm", "theta3_relative")),
        *((name, _I32) for name in ("needs_calibration", "jump", "hang_in_init")),
        ("value", _F64 * 3),
        ("replace", _I32 * 3),
        ("buttons", _I32),
        *((name, _F64 * 3) for name in ("hand_nm", "inertia", "damping")),
        ("max_velocity_rad_s", _F64),
        *((name, _F64 * 3) for name in ("angle_rad", "velocity_rad_s", "zero_rad", "sent_mnm")),
        ("sent_ns", _I64),
        ("frames", _U64),
        ("log_count", _U64),
        *((name, _I32) for name in ("running", "open", "force_output", "bad_returns", "errors")),
        *((name, _I32) for name in ("left_open", "reserved_2", "pid")),
        ("log", LogEntry * LOG),
    )


def missing() -> str | None:
    """Say why the stand-in cannot be built here; None if it can."""
    return None if shutil.which("cc") else "no C compiler: `cc` is not on the PATH"


def library() -> Path:
    """Build the library once for each version of its source and return its path."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "farhand"
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    target = cache / f"fake_libHD-{digest}.so"
    if not target.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as scratch:
            built = Path(scratch) / "libHD.so"
            flags = ["-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-pthread"]
            compiler = shutil.which("cc") or "cc"
            subprocess.run([compiler, *flags, str(SOURCE), "-lm", "-o", str(built)], check=True)
            built.replace(target)
    return target


class FakeHd:
    """A PHANToM that is not there: give a driver `library` and `device_name`, and use `block`."""

    def __init__(self) -> None:
        descriptor = os.memfd_create("farhand-fake-hd")
        weakref.finalize(self, os.close, descriptor)
        os.ftruncate(descriptor, ctypes.sizeof(Block))
        self.block = Block.from_buffer(mmap.mmap(descriptor, ctypes.sizeof(Block)))
        self.block.angle_rad[:] = (0.0, 0.2, 0.3)
        self.device_name = f"/proc/{os.getpid()}/fd/{descriptor}"
        self.library = str(library())

    @property
    def sent_nm(self) -> list[float]:
        """What the motors got last: turret, thigh, shin [N·m]; no servo loop, no torque."""
        return [1e-3 * value for value in self.block.sent_mnm]

    def frames(self, count: int) -> None:
        """Let the servo loop begin and end this many frames."""
        until = self.block.frames + count
        self.wait(lambda: self.block.frames >= until or not self.block.running)

    def wait(self, condition: Callable[[], bool], limit_s: float = 20.0) -> None:
        """Wait for a condition; fail if it does not come."""
        end_s = time.monotonic() + limit_s
        while not condition():
            if time.monotonic() > end_s:
                raise TimeoutError("the stand-in for OpenHaptics did not do what was awaited")
            time.sleep(2e-4)
