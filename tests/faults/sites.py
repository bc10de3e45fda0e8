"""Both daemons, to be killed, suspended, moved and restarted, and an observer that hears them."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from farhand.feed import DASHBOARD
from site_runtime.keys import SiteId
from site_runtime.security.authority import create_authority
from site_runtime.security.identity import Identity
from site_runtime.session import Session, load_session
from site_runtime.supervisor import State
from telemetry.rows import RowArray, row_dtype
from tests.faults import wall_clock
from tests.faults.companion import ROOT, Companion
from tests.faults.network import ImpairedNetwork
from tests.faults.observer import Recording
from tests.faults.session import NAME, write_session
from tests.faults.wall_clock import WallClock
from tests.ports import free_port

LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
BOTH = (LOCAL, REMOTE)
DEADLINE_S = 30.0
ORPHAN_S = 600  # a daemon whose test was killed ends by itself
STEADY_S = 0.5
LAN_LEASE_S = 10.0  # outlasts every suspension: all that a suspended site is sent waits for it
WAN_LEASE_S = 1.0


class NotReached(AssertionError):  # noqa: N818  a failed expectation
    """A site did not do in time what it had to."""


@dataclass
class Daemon:
    """One run of one site."""

    site: SiteId
    process: subprocess.Popen[bytes]
    endpoint: str
    log: Path
    epoch: int = 0
    killed_ns: int = 0

    def text(self) -> str:
        """The words it printed, without frames."""
        return " ".join(re.sub("[─-╿]", " ", self.log.read_text(encoding="utf-8")).split())


class SitePair:
    """A local and a remote daemon on loopback, behind a router, or on an impaired network.

    On the network each site has its own side, and an observer there, so that telemetry never
    crosses what is impaired; a router is on the local side. All are processes of one machine: all
    stamps are CLOCK_MONOTONIC. Over "tls" all show certificates; "sealed" is that, with packets
    sealed over UDP.
    """

    def __init__(
        self,
        folder: Path,
        *,
        network: ImpairedNetwork | None = None,
        routed: bool = False,
        operator: dict[str, object] | None = None,
        orphan_s: float = ORPHAN_S,
        protocol: str = "tcp",
        profile: str | None = None,
        channel: dict[str, object] | None = None,
    ) -> None:
        self._folder = folder
        self._sealed = protocol == "sealed"
        self._protocol = "tls" if self._sealed else protocol
        self._profile = profile
        self._channel = channel
        self._network = network
        self._security = self._make_keys() if self._protocol == "tls" else None
        self._operator = operator
        self._orphan_s = orphan_s
        self._endpoints = {site: self._free_endpoint(site) for site in BOTH}
        self._router_endpoint = self._free_endpoint(LOCAL) if routed else None
        self._router: subprocess.Popen[bytes] | None = None
        self.all: list[Daemon] = []
        self.daemons: dict[SiteId, Daemon] = {}
        self.clocks: dict[SiteId, WallClock] = {}
        if wall_clock.COMPILER is not None:
            self.clocks = {site: WallClock(folder, site.label) for site in BOTH}
        self.files = {site: self.write_session(site) for site in BOTH}
        # one a side, or one for all; with certificates it dials the site of its side
        dialled = self._security is not None
        sides = BOTH if network is not None else (LOCAL,)
        self._observer_endpoints = {
            site: self._endpoints[site] if dialled else f"tcp/127.0.0.1:{free_port()}"
            for site in sides
        }
        recordings = {site: folder / f"observed_{site.label}.rows" for site in sides}
        self._observers = [
            Companion(
                self._command(
                    site, "tests.faults.observer", self._observer_endpoints[site], NAME,
                    str(recordings[site]), *([str(self.files[site])] if dialled else ()),
                )
            )
            for site in sides
        ]  # fmt: skip
        self._recordings = {
            site: Recording(recordings[site if network is not None else LOCAL]) for site in BOTH
        }
        if routed:
            self.start_router()

    @cached_property
    def session(self) -> Session:
        """The session of both sites."""
        return load_session(self.files[LOCAL])

    def write_session(self, site: SiteId, **changes: float) -> Path:
        """Write a session file for a site; returns its path."""
        return write_session(
            self._folder / f"{site.label}_{time.monotonic_ns()}.toml",
            lease_s=LAN_LEASE_S if self._network is None else WAN_LEASE_S,
            router=self._router_endpoint,
            profile=self._profile,
            channel=self._channel,
            operator=self._operator,
            network=self._security,
            **changes,  # type: ignore[arg-type]
        )

    def endpoint(self, site: SiteId) -> str:
        """Where a site listens."""
        return self._endpoints[site]

    def start(self, *sites: SiteId, dial_peer: bool = False) -> None:
        """Start sites, and wait for their first rows. With `dial_peer` the remote one dials too."""
        for site in sites:
            self.daemons[site] = self._start(site, self._endpoints[site], dial_peer)
        for site in sites:
            self._identify(self.daemons[site])

    def start_second(self, site: SiteId) -> Daemon:
        """Start one more daemon of a site beside the present one."""
        daemon = self._start(site, self._free_endpoint(site), dial_peer=True)
        self._identify(daemon)
        return daemon

    def move(self, site: SiteId) -> None:
        """Give a site another port, for its next start."""
        self._endpoints[site] = self._free_endpoint(site)

    def kill(self, site: SiteId) -> None:
        """SIGKILL; returns when the process is gone. Works on a suspended one too."""
        self.end(self.daemons[site])

    def end(self, daemon: Daemon) -> None:
        """SIGKILL one daemon."""
        daemon.killed_ns = daemon.killed_ns or time.monotonic_ns()
        daemon.process.kill()
        daemon.process.wait()

    def signal(self, site: SiteId, number: signal.Signals) -> None:
        """Send a signal: SIGSTOP, SIGCONT, SIGUSR1, SIGUSR2."""
        self.daemons[site].process.send_signal(number)

    def start_router(self) -> None:
        """Start the router that the sites were told of; returns once it relays."""
        log = self._folder / f"router_{time.monotonic_ns()}.log"
        command = ("farhand", "router", str(self.files[LOCAL]), "--duration", str(self._orphan_s))
        with log.open("wb") as printed:
            self._router = subprocess.Popen(
                self._command(LOCAL, *command),
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=printed,
            )
        self.until(lambda: b"farhand router" in log.read_bytes(), "the router relays")

    def kill_router(self) -> None:
        """Kill it."""
        assert self._router is not None
        self._router.kill()
        self._router.wait()

    def rows(self, site: SiteId, since_ns: int = 0) -> RowArray:
        """Rows of a site's present run."""
        return self.rows_of(self.daemons[site], since_ns)

    def rows_of(self, daemon: Daemon, since_ns: int = 0) -> RowArray:
        """Rows of one daemon; none of one that ended before it was heard."""
        if not daemon.epoch:
            return np.empty(0, row_dtype(2, 2))
        return self._recordings[daemon.site].rows(daemon.site, daemon.epoch, since_ns)

    def state(self, site: SiteId) -> str:
        """Name of a site's newest state."""
        return State(self.rows(site, time.monotonic_ns() - 10**9 * 5)["state"][-1]).name

    def until(self, condition: Callable[[], bool], what: str, within_s: float = DEADLINE_S) -> None:
        """Wait for a condition; NotReached with the sites' words if it does not come."""
        end_s = time.monotonic() + within_s
        while not condition():
            if time.monotonic() > end_s:
                raise NotReached(f"not within {within_s} s: {what}\n{self.history()}")
            time.sleep(0.02)

    def until_left(self, site: SiteId, since_ns: int, state: str = "ENGAGED") -> None:
        """Wait until a site has been in another state at any time since."""
        value = State[state]
        self.until(
            lambda: bool((self.rows(site, since_ns)["state"] != value).any()),
            f"{site.label} leaves {state}",
        )

    def recorded(self, site: SiteId) -> list[Path]:
        """Segments that the site's runs have recorded, in their order."""
        folder = self._state_folder(site) / "farhand" / NAME / site.label
        return sorted(
            path for path in folder.glob("*.mcap") if not path.name.startswith("incident")
        )

    def until_steady(self, within_s: float = DEADLINE_S) -> None:
        """Wait until both have been ENGAGED on a loop younger than certified for half a second."""

        def steady(site: SiteId) -> bool:
            rows = self.rows(site, time.monotonic_ns() - round(STEADY_S * 1e9))
            engaged = rows["state"] == State["ENGAGED"]
            fresh = rows["round_trip_s"] <= rows["certified_round_trip_s"]
            return len(rows) > 50 and bool((engaged & fresh).all())

        what = "both steadily ENGAGED on a fresh loop"
        self.until(lambda: all(map(steady, BOTH)), what, within_s)

    def history(self) -> str:
        """What the daemons printed, for failures."""
        ends = [(daemon, daemon.process.poll()) for daemon in self.all]
        return "\n".join(
            f"{daemon.site.label} ({'running' if code is None else code}): {daemon.text()}"
            for daemon, code in ends
        )

    def crashed(self) -> list[Daemon]:
        """Daemons that ended by themselves."""
        return [d for d in self.all if d.process.poll() not in (None, -signal.SIGKILL)]

    def close(self) -> None:
        """Kill all that was started."""
        for daemon in self.all:
            self.end(daemon)
        if self._router is not None:
            self.kill_router()
        for observer in self._observers:
            observer.close()
        for clock in self.clocks.values():
            clock.close()

    def _start(self, site: SiteId, endpoint: str, dial_peer: bool) -> Daemon:
        observer = self._observer_endpoints.get(site, self._observer_endpoints[LOCAL])
        dialled = [] if self._security is not None else [observer]
        if self._router_endpoint is not None:
            dialled.append(self._router_endpoint)
        elif site is LOCAL or dial_peer:
            dialled.append(self._endpoints[site.peer])
        command = self._command(
            site, f"{site.label}_site", str(self.files[site]), "--duration", str(self._orphan_s),
            "--listen", endpoint, *(word for place in dialled for word in ("--connect", place)),
        )  # fmt: skip
        log = self._folder / f"{site.label}_{time.monotonic_ns()}.log"
        clock = self.clocks.get(site)
        with log.open("wb") as printed:
            process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=os.environ
                | {"XDG_STATE_HOME": str(self._state_folder(site))}
                | (clock.environment if clock else {}),
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=printed,
            )
        daemon = Daemon(site, process, endpoint, log)
        self.all.append(daemon)
        return daemon

    def _make_keys(self) -> dict[str, object]:
        """Make everybody's keys; return what the session file says of them."""
        hosts = ["127.0.0.1"]
        if self._network is not None:
            hosts = [self._network.address(site) for site in BOTH]
        authority = create_authority(self._folder / "keys", NAME)
        for name in ("local", "remote", DASHBOARD):
            authority.issue(Identity(name), hosts)
        security: dict[str, object] = {"security": "mtls", "keys": str(authority.folder)}
        if self._sealed:
            address = hosts[REMOTE % len(hosts)]
            place = f"udp/{address}:{free_port()}"
            security |= {"packets_listen": place, "packets_connect": place}
        return security

    def _state_folder(self, site: SiteId) -> Path:
        return self._folder / f"state_{site.label}"

    def _identify(self, daemon: Daemon) -> None:
        """Wait for the daemon's first rows: their epoch is its name."""
        recording = self._recordings[daemon.site]
        known = {other.epoch for other in self.all if other.site is daemon.site}

        def heard() -> bool:
            if daemon.process.poll() is not None:
                raise NotReached(f"it ended at once\n{self.history()}")
            return not known.issuperset(recording.runs(daemon.site))

        self.until(heard, f"the first rows of {daemon.site.label}")
        (daemon.epoch,) = set(recording.runs(daemon.site)) - known

    def _command(self, side: SiteId, module: str, *arguments: str) -> list[str]:
        command = [sys.executable, "-m", module, *arguments]
        return command if self._network is None else self._network.command(side, command)

    def _free_endpoint(self, site: SiteId) -> str:
        address = "127.0.0.1" if self._network is None else self._network.address(site)
        return f"{self._protocol}/{address}:{free_port()}"
