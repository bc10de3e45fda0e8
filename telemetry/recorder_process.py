"""The site's end of its flight recorder: the memory that both share, its start, its end."""

import mmap
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from telemetry.recorder import RecorderOptions
from telemetry.row_ring import RowRing
from telemetry.rows import TelemetryError

BEHIND_ROWS: Final = 5000
"""Rows not yet on the disk from which on a recorder counts as behind."""

_START_S: Final = 15.0
_END_S: Final = 3.0  # less than the patience of whoever ends the site
_POLL_S: Final = 2e-3


class SharedMemory:
    """Memory that a process started later may use too; it lasts as long as one of them does."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("farhand-rows")

    def allocate(self, size: int) -> mmap.mmap:
        """Return zeroed memory of so many bytes, all of it present. Once."""
        os.ftruncate(self.descriptor, size)
        return mmap.mmap(self.descriptor, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)

    def close(self) -> None:
        """Give up the descriptor; what is mapped stays."""
        os.close(self.descriptor)


class RecorderProcess:
    """A running recorder of a ring in shared memory; TelemetryError if it does not come up.

    It outlives the site for as long as it has rows to write; leaving `with` waits a while for it.
    """

    def __init__(self, ring: RowRing, memory: SharedMemory, options: RecorderOptions) -> None:
        self.folder = options.folder
        self._ring = ring
        self._closed = False
        root = str(Path(__file__).parents[1])
        paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            [
                sys.executable,
                "-P",  # no other `telemetry` that lies in the working directory
                "-m",
                "telemetry.recorder",
                str(memory.descriptor),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,  # it may outlive the site; what it has to say is its status
            cwd="/",
            pass_fds=(memory.descriptor,),
            env=os.environ | {"PYTHONPATH": paths},
            start_new_session=True,
        )
        try:
            self._tell(options)
            self._await_start()
        except BaseException:
            self._process.kill()
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def incidents(self) -> int:
        """Incidents kept so far."""
        return self._ring.status.incidents

    @property
    def trouble(self) -> str | None:
        """What is wrong with the recording, None if nothing is. From any thread."""
        status = self._ring.status
        ended = self._process.poll() is not None
        behind = self._ring.row_count - status.written - status.lost
        troubles = []
        if not status.recording:
            troubles.append(f"not recording: {status.error}")
        elif ended and (self._process.returncode != 0 or behind):
            troubles.append(f"the recorder ended with code {self._process.returncode}")
        elif self._closed and not ended:
            troubles.append(f"the recorder still writes, {behind} rows are left")
        elif behind > BEHIND_ROWS:
            troubles.append(f"the recorder is {behind} rows behind")
        if status.lost:
            troubles.append(f"{status.lost} rows not recorded")
            if status.recording and status.error:
                troubles.append(status.error)
        return ", ".join(troubles) or None

    def close(self) -> None:
        """Tell it that the site has ended; wait until it has written all, but not for ever."""
        assert self._process.stdin is not None  # noqa: S101 - a pipe was asked for
        self._closed = True
        with suppress(OSError):
            self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _tell(self, options: RecorderOptions) -> None:
        assert self._process.stdin is not None  # noqa: S101
        with suppress(BrokenPipeError):  # it has ended, which is told below
            self._process.stdin.write(options.to_json().encode() + b"\n")
            self._process.stdin.flush()

    def _await_start(self) -> None:
        deadline_s = time.monotonic() + _START_S
        while not self._ring.status.recording:
            ended = self._process.poll() is not None
            if ended or time.monotonic() > deadline_s:
                why = self._ring.status.error or (
                    "it ended at once" if ended else f"it did not start within {_START_S:g} s"
                )
                raise TelemetryError(
                    f"the flight recorder cannot record in {self.folder}: {why}; "
                    "name another directory, or run with --no-record"
                )
            time.sleep(_POLL_S)
