"""The site's end of the PHANToM's servo process: its start, its memory, its end."""

import mmap
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from hardware.interface import DeviceError
from hardware.phantom_servo import FAULT, STARTING, ServoMemory, ServoOptions

_START_S = 15.0
_END_S = 2.0
_POLL_S = 0.2e-3


class ServoProcess:
    """A running servo process; raises DeviceError if it does not come up."""

    def __init__(self, options: ServoOptions) -> None:
        descriptor = os.memfd_create("farhand-phantom")
        try:
            os.ftruncate(descriptor, ServoMemory.SIZE)
            self.memory = ServoMemory(mmap.mmap(descriptor, ServoMemory.SIZE))
            root = str(Path(__file__).parents[1])
            paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
            self._process = subprocess.Popen(  # noqa: S603 - our own module
                [
                    sys.executable,
                    "-P",  # no other `hardware` that lies in the working directory
                    "-m",
                    "hardware.phantom_servo",
                    str(descriptor),
                    options.to_json(),
                ],
                stdin=subprocess.PIPE,
                stdout=2,  # what a vendor's library prints is no output of this program
                pass_fds=(descriptor,),
                env=os.environ | {"PYTHONPATH": paths},
            )
        finally:
            os.close(descriptor)
        try:
            if not self.wait(lambda: self._up() or not self.alive, _START_S) or not self.alive:
                raise DeviceError(
                    self.memory.text
                    or f"the servo process did not start within {_START_S:g} s, or ended"
                )
            if self.memory.phase == FAULT:
                raise DeviceError(self.memory.text)
        except BaseException:
            self.end()
            raise

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def wait(self, condition: Callable[[], Any], limit_s: float) -> bool:
        """Wait until a condition holds, at most `limit_s`; return whether it does."""
        deadline_s = time.monotonic() + limit_s
        while not condition():
            if time.monotonic() > deadline_s:
                return False
            time.sleep(_POLL_S)
        return True

    def end(self) -> None:
        """Let it send zero torque and leave; force it if it does not."""
        assert self._process.stdin is not None  # noqa: S101 - a pipe was asked for
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _up(self) -> bool:
        phase = self.memory.phase
        return phase == FAULT or (phase != STARTING and self.memory.state.get()[0] != 0)
