"""A session whose parties show certificates: its keys, its daemons, its relay, and intruders."""

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import tomlkit

from channel.zenoh_link import ZenohNode, ZenohSettings
from farhand.feed import Feed
from site_runtime.keys import SiteId, state_key
from site_runtime.security.authority import Authority, create_authority
from site_runtime.security.credentials import AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE
from site_runtime.security.identity import Identity
from site_runtime.session import Session, load_session
from site_runtime.supervisor import State
from telemetry.rows import RowArray
from tests.ports import free_port

ROOT = Path(__file__).parents[2]
NAME = "secured"
DEADLINE_S = 60.0
RATE_HZ = 250
ORPHAN_S = 600
LOOPBACK = ("127.0.0.1",)
PARTIES = tuple(Identity(name) for name in ("local", "remote", "router", "dashboard"))
FORGED = b"forged"
FORGED_S = 0.8


def until(condition: Callable[[], bool], what: str, within_s: float = DEADLINE_S) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, f"not within {within_s} s: {what}"
        time.sleep(0.02)


def make_keys(folder: Path, parties: Iterable[Identity] = PARTIES) -> Authority:
    """An authority, and a certificate of each party for 127.0.0.1."""
    authority = create_authority(folder, NAME)
    for party in parties:
        authority.issue(party, LOOPBACK)
    return authority


def write_session(path: Path, keys: Path, **network: object) -> Path:
    """The demo's arms in free motion, with certificates, and patient: time is not at stake."""
    demo = ROOT / "experiments" / "demo.toml"
    document = tomlkit.parse(demo.read_text(encoding="utf-8")).unwrap()
    document["name"] = NAME
    document["loop"] = {"rate_hz": RATE_HZ}
    document["channel"] = {"injection": "off"}
    document["engagement"] = {
        "alignment": "none",
        "ramp_s": 0.2,
        "hold_after_s": 1.0,
        "beyond_certificate": "warn",
    }
    document["network"] = {"security": "mtls", "keys": str(keys), "lease_s": 1.0, **network}
    for contact in ("environment", "obstacles", "null_space", "sub_tasks"):
        del document["remote"][contact]
    path.write_text(tomlkit.dumps(document), encoding="utf-8")
    return path


def dialling(folder: Path | None, *endpoints: str) -> ZenohNode:
    """A node that dials with the certificate in `folder`, or none, and grants everything."""
    return ZenohNode(ZenohSettings(connect=endpoints, configuration=tls(folder)))


def tls(folder: Path | None, trust: Path | None = None) -> dict[str, object]:
    """Zenoh's TLS with the certificate in a folder; it trusts whoever that authority signed."""
    settings: dict[str, object] = {"verify_name_on_connect": True}
    if folder is not None:
        for way in ("listen", "connect"):
            settings[f"{way}_private_key"] = str(folder / KEY_FILE)
            settings[f"{way}_certificate"] = str(folder / CERTIFICATE_FILE)
        settings["enable_mtls"] = True
    authority = trust or folder
    if authority is not None:
        settings["root_ca_certificate"] = str(authority / AUTHORITY_FILE)
    return {"transport/link/tls": settings}


class SecuredPair:
    """Both daemons, with a relay or without, and a dashboard's feed."""

    def __init__(self, folder: Path, relay: str | None = None, sealed: bool = False) -> None:
        self.folder = folder
        self.keys = folder / "keys"
        self.authority = make_keys(self.keys)
        self.stolen = folder / "stolen"
        self.endpoints = {site: f"tls/127.0.0.1:{free_port()}" for site in SiteId}
        network: dict[str, object] = {
            "local_listen": self.endpoints[SiteId.LOCAL],
            "remote_listen": self.endpoints[SiteId.REMOTE],
            "local_connect": self.endpoints[SiteId.REMOTE],
        }
        if relay is not None:
            self.relay = f"{relay}/127.0.0.1:{free_port()}"
            network = {"router": self.relay}
        if sealed:
            self.packets = f"udp/127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
            network |= {"packets_listen": self.packets, "packets_connect": self.packets}
        self.file = write_session(folder / "session.toml", self.keys, **network)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._feed: Feed | None = None
        self._newest: dict[SiteId, RowArray] = {}

    @property
    def session(self) -> Session:
        return load_session(self.file)

    def steal(self, name: str) -> Path:
        """Copy a party's folder as it is now."""
        place = self.stolen / name
        shutil.copytree(self.keys / name, place)
        return place

    def start(self, *names: str, options: Sequence[str] = ()) -> None:
        """Start `local`, `remote`, `router`, with options beyond the usual ones."""
        for name in names:
            site = name in ("local", "remote")
            command = [f"{name}_site"] if site else ["farhand", name]
            quietly = ["--quiet", "--no-record"] if site else []
            usual = [str(self.file), "--duration", str(ORPHAN_S), *quietly]
            with (self.folder / f"{name}.log").open("ab") as log:
                self._processes[name] = subprocess.Popen(
                    [sys.executable, "-m", *command, *usual, *options],
                    cwd=ROOT,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                )

    def kill(self, name: str) -> None:
        process = self._processes.pop(name)
        process.kill()
        process.wait()

    def signal(self, name: str, number: int) -> None:
        self._processes[name].send_signal(number)

    def text(self, name: str) -> str:
        """What it printed."""
        return (self.folder / f"{name}.log").read_text(encoding="utf-8")

    def watch(self) -> None:
        """Attach a dashboard's feed."""
        self._feed = Feed(self.session)

    def until_engaged(self) -> None:
        """Wait until both tell of a fresh ENGAGED."""
        self._newest.clear()

        def engaged() -> bool:
            self.update()
            return all(
                site in self._newest and self._newest[site]["state"][-1] == State.ENGAGED
                for site in SiteId
            )

        try:
            until(engaged, "both ENGAGED")
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.history()}") from None

    def history(self) -> str:
        logs = sorted(self.folder.glob("*.log"))
        return "\n".join(f"{log.name}: {log.read_text(encoding='utf-8')}" for log in logs)

    def update(self) -> None:
        assert self._feed is not None
        for batch, _ in self._feed.receive():
            self._newest[SiteId(batch.site)] = batch.rows

    def state(self, site: SiteId) -> State:
        """The state of a site by the newest row that came."""
        return State(self._newest[site]["state"][-1])

    def rejected(self, site: SiteId) -> int:
        """How many packets a site has refused, by rows made from now on."""
        asked_ns = time.monotonic_ns()

        def fresh() -> bool:
            self.update()
            rows = self._newest.get(site)
            return rows is not None and rows["stamp_ns"][-1] > asked_ns

        until(fresh, f"rows of {site.label}")
        return int(self._newest[site]["rejected"][-1].sum())

    def refused_while(self, node: ZenohNode, speaker: SiteId) -> int:
        """Let a node speak in a site's name; return how many more packets the other one refused."""
        before = self.rejected(speaker.peer)
        publish = node.publisher(state_key(NAME, speaker))
        end_s = time.monotonic() + FORGED_S
        while time.monotonic() < end_s:
            publish(FORGED)
            time.sleep(0.01)
        return self.rejected(speaker.peer) - before

    def close(self) -> None:
        if self._feed is not None:
            self._feed.close()
        for name in list(self._processes):
            self.kill(name)


def ended(file: Path, site: SiteId, *options: str) -> tuple[int, str]:
    """Run a site that ends by itself; return its exit code and what it says on stderr."""
    done = subprocess.run(
        [sys.executable, "-m", f"{site.label}_site", str(file), "--no-record", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    return done.returncode, done.stderr
