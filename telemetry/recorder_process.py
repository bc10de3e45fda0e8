"""The site's end of its flight recorder: its start, its troubles, its end."""

import time
from types import TracebackType
from typing import Final, Self

from telemetry.companion import Companion, SharedMemory
from telemetry.recorder import RecorderOptions
from telemetry.row_ring import RowRing
from telemetry.rows import TelemetryError

BEHIND_ROWS: Final = 5000
"""Rows not yet on the disk from which on a recorder counts as behind."""

_START_S: Final = 15.0
_END_S: Final = 3.0  # less than the patience of whoever ends the site
_POLL_S: Final = 2e-3


class RecorderProcess:
    """A running recorder of a ring in shared memory; TelemetryError if it does not come up.

    It outlives the site for as long as it has rows to write; leaving `with` waits a while for it.
    """

    def __init__(self, ring: RowRing, memory: SharedMemory, options: RecorderOptions) -> None:
        self.folder = options.folder
        self._ring = ring
        self._closed = False
        self._process = Companion("telemetry.recorder", memory, options.to_json())
        try:
            self._await_start()
        except BaseException:
            self._process.kill()
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
        code = self._process.exit_code
        behind = self._ring.row_count - status.written - status.lost
        troubles = []
        if not status.recording:
            troubles.append(f"not recording: {status.error}")
        elif code is not None and (code != 0 or behind):
            troubles.append(f"the recorder ended with code {code}")
        elif self._closed and code is None:
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
        self._closed = True
        self._process.close(_END_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _await_start(self) -> None:
        deadline_s = time.monotonic() + _START_S
        while not self._ring.status.recording:
            ended = self._process.exit_code is not None
            if ended or time.monotonic() > deadline_s:
                why = self._ring.status.error or (
                    "it ended at once" if ended else f"it did not start within {_START_S:g} s"
                )
                raise TelemetryError(
                    f"the flight recorder cannot record in {self.folder}: {why}; "
                    "name another directory, or run with --no-record"
                )
            time.sleep(_POLL_S)
