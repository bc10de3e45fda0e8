"""What a daemon says on stderr: lines for people, or JSON lines for programs."""

import json
import sys
import time
from datetime import UTC, datetime
from enum import StrEnum
from math import isfinite
from typing import Final

from rich.console import Console

from telemetry.events import Level

_STYLES: Final = {"INFO": None, "WARN": "yellow", "ERROR": "red"}


class LogFormat(StrEnum):
    """How a line is written."""

    TEXT = "text"
    JSON = "json"


class DaemonLog:
    """One line a thing that happened; any thread. `about` names the run, in every JSON line."""

    def __init__(self, site: str, log_format: LogFormat = LogFormat.TEXT) -> None:
        self.format = log_format
        self._site = site
        self._session: str | None = None
        self._epoch: str | None = None
        self._console = Console(stderr=True)

    def about(self, session: str, epoch: int) -> None:
        """Name the session and the run; the epoch as text, since it is beyond a double's digits."""
        self._session, self._epoch = session, str(epoch)

    def say(self, text: str, level: Level = "INFO") -> None:
        """Say what concerns the daemon rather than a moment of its site."""
        if self.format is LogFormat.JSON:
            self._write_json(time.time_ns(), level, None, text, {})
        else:
            self._console.print(
                text, style=_STYLES[level], highlight=False, markup=False, soft_wrap=True
            )

    def event(self, wall_ns: int, level: Level, state: str, text: str, **numbers: float) -> None:
        """Say what happened at the site at this wall time [ns]; numbers with units in their names.

        Those that are not finite are null in JSON, which knows no other.
        """
        if self.format is LogFormat.JSON:
            self._write_json(wall_ns, level, state, text, numbers)
        else:
            # over a line that is rewritten in place, which comes again below it
            begin = "\r\x1b[K" if sys.stderr.isatty() else ""
            _write(f"{begin}{_utc(wall_ns)} {self._site:6} {state}: {text}\n")

    def _write_json(
        self, wall_ns: int, level: Level, state: str | None, text: str, numbers: dict[str, float]
    ) -> None:
        line = {
            "time": _utc(wall_ns),
            "level": level,
            "site": self._site,
            "session": self._session,
            "epoch": self._epoch,
            "state": state,
            "text": text,
            **{name: value if isfinite(value) else None for name, value in numbers.items()},
        }
        _write(json.dumps(line, ensure_ascii=False, allow_nan=False) + "\n")


def _utc(wall_ns: int) -> str:
    seconds, rest_ns = divmod(wall_ns, 1_000_000_000)
    moment = datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest_ns // 1000)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _write(line: str) -> None:
    sys.stderr.write(line)
    sys.stderr.flush()
