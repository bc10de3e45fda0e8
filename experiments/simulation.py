"""Both sites' own code on one manual clock: a session simulated, bit for bit repeatable."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from channel.memory_link import memory_links
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.keys import SiteId
from site_runtime.session import Session, SessionError
from site_runtime.site import Site
from site_runtime.supervisor import State
from telemetry.rows import RowArray
from telemetry.stream import TelemetryStream

_SETTLE_NS = 100_000_000
_LOOK_TICKS = 100
_LOCAL_EPOCH, _REMOTE_EPOCH = 1, 2


@dataclass(frozen=True, slots=True)
class Run:
    """The rows of both sites from session time zero on, and why a site failed, if one did."""

    local: RowArray
    remote: RowArray
    failures: tuple[str, ...]


class Simulation:
    """Two sites, one clock, an in-memory link.

    The channel fills before session time zero, robots standing still under their brakes: at zero
    both sites engage at once, each knowing the other's past, as the paper's equations assume.
    """

    def __init__(self, session: Session) -> None:
        _refuse_real_devices(session)
        self.period_ns = session.period_ns
        self._start_ns = _warm_up_ns(session)
        self.clock = ManualClock()
        local_link, remote_link = memory_links()
        self.local = build_local_site(
            session,
            Surroundings(
                local_link,
                self.clock,
                self._start_ns,
                _LOCAL_EPOCH,
                _unpublished,
                shared_clock=True,
            ),
        )
        self.remote = build_remote_site(
            session,
            Surroundings(
                remote_link,
                self.clock,
                self._start_ns,
                _REMOTE_EPOCH,
                _unpublished,
                shared_clock=True,
            ),
        )

    def run(
        self,
        duration_s: float,
        progress: Callable[[float], None] | None = None,
        until: Callable[[Run], bool] | None = None,
    ) -> Run:
        """Run to session time `duration_s`, until a site fails, or until `until` says so.

        Every 100 ticks `progress` gets the session time [s], and `until` the newest second's rows.
        """
        sites = (self.local, self.remote)
        kept = tuple(_KeptRows(site.telemetry) for site in sites)
        for site in sites:
            site.open()
        ticks = round(self._start_ns / self.period_ns + duration_s * 1e9 / self.period_ns)
        for tick in range(ticks + 1):
            self.clock.sleep_until_ns(tick * self.period_ns)
            for site in sites:
                site.tick()
            if any(site.failure for site in sites):
                break
            if tick % _LOOK_TICKS:
                continue
            for rows in kept:
                rows.take()
            if progress is not None:
                progress(max(0.0, (self.clock.now_ns() - self._start_ns) * 1e-9))
            if until is not None and until(self._newest_second()):
                break
        for site in sites:
            site.close()
        local, remote = (rows.since_session_start() for rows in kept)
        # the row of the tick that failed has a reading, but nothing that came of it
        shared = min(np.count_nonzero(rows["state"] != State.FAULT) for rows in (local, remote))
        return Run(local[:shared], remote[:shared], tuple(map(_failure, filter(_failed, sites))))

    def _newest_second(self) -> Run:
        """Rows of both sites, of the last second since session time zero."""
        since_ns = max(0, self.clock.now_ns() - self._start_ns)
        count = min(since_ns, 1_000_000_000) // self.period_ns
        local, remote = (site.telemetry.last(count) for site in (self.local, self.remote))
        return Run(local, remote, ())


class _KeptRows:
    """All rows of one site, taken out of its ring before they are overwritten."""

    def __init__(self, telemetry: TelemetryStream) -> None:
        self._telemetry = telemetry
        self._pieces: list[RowArray] = []
        self._taken = 0

    def take(self) -> None:
        """Take those that are new."""
        count = self._telemetry.count
        self._pieces.append(self._telemetry.last(count - self._taken))
        self._taken = count

    def since_session_start(self) -> RowArray:
        """Return those from session time zero on."""
        self.take()
        rows = np.concatenate(self._pieces)
        return rows[rows["time_ns"] >= 0]


def _unpublished(batch: bytes) -> None:
    """Nobody listens: rows are taken where they are."""


def _refuse_real_devices(session: Session) -> None:
    """Raise SessionError for what would open a vendor's library or a bus on a manual clock."""
    for site in SiteId:
        own = session.site(site)
        if own.device.driver != "simulated":
            raise SessionError(
                f'{site.label}.device.driver = "{own.device.driver}": simulation moves simulated '
                'robots only; use driver = "simulated", or run the site itself'
            )
        if own.force_sensor is not None:
            raise SessionError(
                f"{site.label}.force_sensor: simulation knows the force by itself; leave it out, "
                "or run the site itself"
            )


def _warm_up_ns(session: Session) -> int:
    """Long enough for the channel to be full of samples, in whole ticks."""
    settings = session.channel
    fill_s = 0.0
    if settings.injection != "off":
        fill_s = settings.local_to_remote.bound_s + settings.remote_to_local.bound_s
    warm_up_ns = round(fill_s * 1e9) + _SETTLE_NS + 10 * session.send_period_ns
    return -(-warm_up_ns // session.period_ns) * session.period_ns


def _failed(site: Site) -> bool:
    return site.failure is not None


def _failure(site: Site) -> str:
    return f"{site.identity.label}: {type(site.failure).__name__}: {site.failure}"
