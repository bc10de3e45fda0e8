"""What happens at a site, told as it comes: from any thread but the loop's."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Final, Protocol

from site_runtime.daemon_log import DaemonLog
from site_runtime.site import Site
from site_runtime.supervisor import State
from telemetry.events import Level
from telemetry.row_ring import SiteEvent

TROUBLE_INTERVAL_S: Final = 10.0
"""A trouble that goes on is told again, if it changed, at most this often."""

_LEVELS: Final[dict[str, Level]] = {"HOLD": "WARN", "FAULT": "ERROR", "EMERGENCY_STOP": "ERROR"}


class Companion(Protocol):
    """A process beside the site's."""

    @property
    def trouble(self) -> str | None:
        """What is wrong with it, None if nothing is."""
        ...


@dataclass(slots=True)
class _Watched:
    companion: Companion
    told: str | None = None
    told_s: float = -inf


class SiteEvents:
    """Tells the log what the site put into its ring of events, and what its companions suffer.

    A stamp of the site and `wall_offset_ns` are the wall clock as the run started: never a step.
    """

    def __init__(
        self, site: Site, companions: Sequence[Companion], log: DaemonLog, wall_offset_ns: int
    ) -> None:
        self._site = site
        self._log = log
        self._wall_offset_ns = wall_offset_ns
        self._next = 0
        self._state = site.state.name
        self._watched = [_Watched(companion) for companion in companions]

    def tell(self) -> None:
        """Tell all that is new."""
        events, after = self._site.telemetry.ring.events_from(self._next)
        if missing := after - self._next - len(events):
            self._say("WARN", f"{missing} events of the site came too fast to be told")
        self._next = after
        for event in events:
            self._tell(event)
        for watched in self._watched:
            self._look_at(watched)

    def _tell(self, event: SiteEvent) -> None:
        name, _, cause = event.text.partition(": ")
        entered = name in State.__members__
        if entered:
            self._state = name
        level = _LEVELS.get(name) or ("WARN" if name == "de-rated" else "INFO")
        margin = self._site.margin
        self._log.event(
            event.stamp_ns + self._wall_offset_ns,
            level,
            self._state,
            cause if entered else event.text,
            round_trip_s=self._site.round_trip_s,
            margin_s=margin.certified_s - margin.loop_s,
        )

    def _look_at(self, watched: _Watched) -> None:
        trouble, told = watched.companion.trouble, watched.told
        now_s = time.monotonic()
        if trouble == told:
            return
        if trouble is None:
            self._say("INFO", f"over: {told}")
        elif told is None or now_s - watched.told_s >= TROUBLE_INTERVAL_S:
            self._say("WARN", trouble)
        else:
            return
        watched.told, watched.told_s = trouble, now_s

    def _say(self, level: Level, text: str) -> None:
        self._log.event(time.time_ns(), level, self._state, text)
