"""Packets over plain UDP, sealed end to end: two daemons, and all who reach the port."""

import json
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from struct import pack

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from channel.packet import PacketError, decode, encode
from channel.sealed_link import OVERHEAD_BYTES, Refusal
from channel.zenoh_link import Subscription, ZenohNode, ZenohSettings
from site_runtime.clock import SteadyClock
from site_runtime.daemon_log import DaemonLog
from site_runtime.keys import SiteId, lease_key, offer_key, state_key, telemetry_key
from site_runtime.operator_requests import OperatorRequests
from site_runtime.seal_keeper import SealKeeper
from site_runtime.security.authority import Authority
from site_runtime.security.credentials import read_credentials
from site_runtime.security.identity import Identity
from site_runtime.security.network import Meeting, meet_as_site
from site_runtime.security.offer import OwnOffer
from site_runtime.session import load_session
from site_runtime.supervisor import State
from telemetry.events import Level
from tests.loopback.secured import (
    FORGED,
    LOOPBACK,
    NAME,
    ROOT,
    SecuredPair,
    make_keys,
    tls,
    until,
    write_session,
)
from tests.loopback.test_lease import Ear, Robot
from tests.ports import free_port

pytestmark = pytest.mark.patient
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
PUBLIC = slice(17, 49)  # of an offer: its key


def at_the_port(place: str, region: str = "local") -> ZenohNode:
    """A node without any certificate that enforces nothing itself."""
    return ZenohNode(ZenohSettings(connect=(place,), configuration={"region_name": region}))


def payloads(ear: Subscription) -> list[bytes]:
    return [payload for _, payload in ear.receive()]


def plain_packet() -> bytes:
    return encode(
        site=0, state=0, session=1, epoch=2, sequence=3, stamp_ns=4, echo_epoch=0,
        echo_stamp_ns=0, echo_arrival_ns=0, used_stamp_ns=0, greatest_age_ns=0,
        vectors=np.ones((3, 2)),
    )  # fmt: skip


def readable(packets: list[bytes]) -> int:
    count = 0
    for data in packets:
        try:
            decode(data)
        except PacketError:
            continue
        count += 1
    return count


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredPair]:
    """Engaged daemons, the remote one listening for packets."""
    pair = SecuredPair(tmp_path_factory.mktemp("sealed"), sealed=True)
    try:
        pair.start("remote", "local")
        pair.watch()
        pair.until_engaged()
        yield pair
    finally:
        pair.close()


@pytest.fixture(scope="module")
def relayed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredPair]:
    """The same behind a relay."""
    pair = SecuredPair(tmp_path_factory.mktemp("sealed-relayed"), relay="tls", sealed=True)
    try:
        pair.start("remote", "local", "router")
        pair.watch()
        pair.until_engaged()
        yield pair
    finally:
        pair.close()


@pytest.mark.parametrize("which", ["pair", "relayed"])
def test_both_engage_and_say_with_whom(which: str, request: pytest.FixtureRequest) -> None:
    pair: SecuredPair = request.getfixturevalue(which)
    pair.until_engaged()
    assert "packets are sealed with remote-1" in pair.text("local")
    assert "packets are sealed with local-1" in pair.text("remote")


def test_an_eavesdropper_could_read_plain_packets_over_udp() -> None:
    """The control of the next test."""
    place = f"udp/127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    with (
        closing(ZenohNode(ZenohSettings(listen=(place,)))) as site,
        closing(at_the_port(place)) as node,
    ):
        link = site.link(state_key(NAME, REMOTE), None)
        ear, heard = node.subscriber(state_key(NAME, REMOTE), 100), []
        until(lambda: (link.send(plain_packet()) and heard.extend(payloads(ear))) or heard, "one")
        assert readable(heard) == len(heard)


@pytest.mark.parametrize("which", ["pair", "relayed"])
def test_an_eavesdropper_reads_nothing(which: str, request: pytest.FixtureRequest) -> None:
    pair: SecuredPair = request.getfixturevalue(which)
    with closing(at_the_port(pair.packets)) as node:
        ear, heard = node.subscriber(state_key(NAME, REMOTE), 1000), []
        until(lambda: heard.extend(payloads(ear)) or len(heard) > 100, "packets")
    assert readable(heard) == 0
    assert {len(data) for data in heard} == {len(plain_packet()) + OVERHEAD_BYTES}
    assert not any(pack("<Q", pair.session.digest) in data for data in heard)
    assert not any(pack(">Q", pair.session.digest) in data for data in heard)


def refused(pair: SecuredPair, reason: Refusal, before: str) -> bool:
    """Whether the remote site has told since that it refused something for this reason."""
    lines = pair.text("remote")[len(before) :].splitlines()
    return any(line.startswith("sealed packets refused") and reason in line for line in lines)


def test_what_is_forged_is_refused_and_told_of(pair: SecuredPair) -> None:
    """With every number right, but for the seal."""
    pair.until_engaged()
    rejected = pair.rejected(REMOTE)
    before = pair.text("remote")
    with closing(at_the_port(pair.packets)) as node:
        ear = node.subscriber(state_key(NAME, REMOTE), 10)
        say = node.publisher(state_key(NAME, LOCAL))
        heard: list[bytes] = []
        until(lambda: heard.extend(payloads(ear)) or bool(heard), "a packet")
        reflected = heard[-1]
        forged = [FORGED, plain_packet(), reflected, bytes([1]) + bytes(200)]

        def told() -> bool:
            for data in forged:
                say(data)
            return refused(pair, Refusal.MALFORMED, before) and refused(pair, Refusal.KEY, before)

        until(told, "told")
    pair.until_engaged()
    assert pair.rejected(REMOTE) == rejected  # none got as far as the site's own checks


def recorded(node: ZenohNode, site: SiteId, count: int) -> list[bytes]:
    ear, heard = node.subscriber(state_key(NAME, site), 1000), []
    until(lambda: heard.extend(payloads(ear)) or len(heard) >= count, "packets")
    ear.close()
    return heard


def test_packets_that_are_repeated_or_changed_are_refused_even_by_the_relay(
    relayed: SecuredPair,
) -> None:
    """At its port they can be heard and said as the relay itself could."""
    relayed.until_engaged()
    rejected = relayed.rejected(REMOTE)
    with (
        closing(at_the_port(relayed.packets, "remote")) as hears,
        closing(at_the_port(relayed.packets, "local")) as says,
    ):
        replay = recorded(hears, LOCAL, 50)
        say = says.publisher(state_key(NAME, LOCAL))
        before = relayed.text("remote")

        def repeat(packets: list[bytes], reason: Refusal) -> bool:
            for data in packets:
                say(data)
            return refused(relayed, reason, before)

        until(lambda: repeat(replay[:5], Refusal.REPLAY), "replays told")
        before = relayed.text("remote")
        # newer than any, and so to be opened, but that the tag is of another
        newer = [d[:5] + pack(">Q", 2**40 + k) + d[13:] for k, d in enumerate(replay[:5])]
        until(lambda: repeat(newer, Refusal.TAG), "changes told")
        relayed.until_engaged()
        assert relayed.rejected(REMOTE) == rejected

        # of a run that is over: by its key, before anything else
        relayed.kill("local")
        relayed.start("local")
        relayed.until_engaged()
        time.sleep(4.0)  # in which packets of the run before are no news
        rejected = relayed.rejected(REMOTE)
        before = relayed.text("remote")
        latest = [d[:5] + pack(">Q", 2**41) + d[13:] for d in replay[-5:]]
        until(lambda: repeat([*replay[-5:], *latest], Refusal.KEY), "the run before told of")
        assert not refused(relayed, Refusal.REPLAY, before)
        relayed.until_engaged()
        assert relayed.rejected(REMOTE) == rejected


def test_who_comes_by_udp_hears_and_says_nothing_but_packets(relayed: SecuredPair) -> None:
    keys = (telemetry_key(NAME, LOCAL), lease_key(NAME), offer_key(NAME, LOCAL))
    with ExitStack() as stack:
        intruder = stack.enter_context(closing(at_the_port(relayed.packets)))
        other = stack.enter_context(closing(at_the_port(relayed.packets, "remote")))
        desk = stack.enter_context(
            closing(
                ZenohNode(
                    ZenohSettings(
                        connect=(relayed.relay,),
                        configuration=tls(relayed.keys / "dashboard") | {"region_name": "observer"},
                    )
                )
            )
        )
        by_udp = [other.subscriber(key, 1000) for key in (*keys, "farhand/**")]
        control = other.subscriber(state_key(NAME, LOCAL), 100)
        at_desk = desk.subscriber(telemetry_key(NAME, LOCAL), 100)
        at_desk_lease = desk.subscriber(lease_key(NAME), 100)
        mouths = [intruder.publisher(key) for key in keys]
        state = intruder.publisher(state_key(NAME, LOCAL))
        rows, poses, leases = [], [], []
        end_s = time.monotonic() + 30.0
        while time.monotonic() < end_s and not (rows and FORGED in poses and leases):
            for mouth in (*mouths, state):
                mouth(FORGED)
            rows += payloads(at_desk)
            leases += payloads(at_desk_lease)
            poses += payloads(control)
            time.sleep(0.01)
        assert rows, "the desk hears telemetry by its certificate"
        assert leases
        assert FORGED in poses, "what the intruder says of poses passes the relay"
        assert FORGED not in rows
        assert FORGED not in leases
        heard = {key for ear in by_udp for key, _ in ear.receive()}
        assert heard <= {state_key(NAME, LOCAL)}  # which `farhand/**` hears with the control


def test_a_flood_of_forged_packets_through_the_relay_is_thinned_and_refused(
    relayed: SecuredPair,
) -> None:
    relayed.until_engaged()
    before = relayed.text("remote")
    over = threading.Event()
    with closing(at_the_port(relayed.packets)) as node:
        say = node.publisher(state_key(NAME, LOCAL))
        until(lambda: bool(node.partners()), "a connection")

        def flood() -> None:
            while not over.wait(0.005):
                for _ in range(50):
                    say(bytes([1]) + bytes(180))

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            until(lambda: refused(relayed, Refusal.KEY, before), "told")
            relayed.until_engaged()
        finally:
            over.set()
            thread.join()


class Wire:
    """UDP between two ports, which can be cut."""

    def __init__(self, to_port: int) -> None:
        self._to = ("127.0.0.1", to_port)
        self._near = socket.socket(type=socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", 0))
        self._far: dict[tuple[str, int], socket.socket] = {}
        self.place = f"udp/127.0.0.1:{self._near.getsockname()[1]}"
        self.cut = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _carry(self) -> None:
        while not self._over.is_set():
            far = {one: client for client, one in self._far.items()}
            ready, _, _ = select.select([self._near, *far], [], [], 0.1)
            for one in ready:
                try:
                    data, sender = one.recvfrom(65535)
                except OSError:  # nobody is there
                    continue
                if one is self._near and sender not in self._far:
                    self._far[sender] = socket.socket(type=socket.SOCK_DGRAM)
                    self._far[sender].connect(self._to)
                if self.cut:
                    continue
                with suppress(OSError):
                    if one is self._near:
                        self._far[sender].send(data)
                    else:
                        self._near.sendto(data, far[one])

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        for one in (self._near, *self._far.values()):
            one.close()


def test_an_outage_of_udp_alone_leads_to_hold_and_back(tmp_path: Path) -> None:
    pair = SecuredPair(tmp_path, sealed=True)
    with closing(Wire(int(pair.packets.rpartition(":")[2]))) as wire, closing(pair):
        text = pair.file.read_text(encoding="utf-8")
        changed = text.replace(
            f'packets_connect = "{pair.packets}"', f'packets_connect = "{wire.place}"'
        )
        assert changed != text
        pair.file.write_text(changed, encoding="utf-8")
        pair.start("remote", "local")
        pair.watch()
        pair.until_engaged()
        for outage_s in (2.0, 8.0):  # longer than a lease; than it takes to open the link anew
            wire.cut = True
            time.sleep(outage_s)
            pair.update()
            # telemetry, by the certificates, goes on
            assert {pair.state(site) for site in SiteId} <= {State.HOLD, State.READY}
            wire.cut = False
            pair.until_engaged()
        assert "nothing that remote-1 has sealed arrives" in pair.text("local")


def test_a_relay_that_was_killed_is_replaced_and_the_pair_engages_again(
    relayed: SecuredPair,
) -> None:
    """First by what two zenohds would be told."""
    files = []
    for option in ("--print-config", "--print-packets-config"):
        command = [sys.executable, "-m", "farhand", "router", str(relayed.file), option]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout)["access_control"]["default_permission"] == "deny"
        files.append(relayed.folder / f"zenohd{option}.json5")
        files[-1].write_text(done.stdout, encoding="utf-8")
    relayed.kill("router")
    with ExitStack() as stack:
        nodes = [
            stack.enter_context(closing(ZenohNode(ZenohSettings(config_file=str(file)))))
            for file in files
        ]
        until(lambda: {"local-1", "remote-1"} <= set(nodes[0].partners()), "both at the relay")
        until(lambda: len(nodes[1].partners()) == 2, "their packets there too")
        relayed.until_engaged()
    relayed.start("router")
    relayed.until_engaged()


def test_a_link_test_goes_where_the_sites_packets_go(tmp_path: Path) -> None:
    pair = SecuredPair(tmp_path, sealed=True)
    words = [sys.executable, "-m", "farhand", "link-test", str(pair.file), "--rate", "250"]
    with closing(pair), (tmp_path / "answer.log").open("ab") as log:
        answer = subprocess.Popen([*words, "--answer"], cwd=ROOT, stdout=log, stderr=log)
        try:
            done = subprocess.run(
                [*words, "--json", "--duration", "2"],
                cwd=ROOT,
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
        finally:
            answer.terminate()
            answer.wait(30)
        assert "packets are sealed with remote-1" in done.stderr, done
        assert "packets are sealed with local-1" in (tmp_path / "answer.log").read_text()
        (rate,) = json.loads(done.stdout)["rates"]
        assert 0.0 < rate["round_trip"]["p50_s"] < 5.0


def test_the_lease_goes_from_hand_to_hand_and_the_seal_with_it(tmp_path: Path) -> None:
    packets = f"udp/127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    with closing(
        Robot(tmp_path, routed=True, packets_listen=packets, packets_connect=packets)
    ) as robot:
        robot.start("router", "farhand", "router", str(robot.file))
        robot.start("remote", "remote_site", str(robot.file))
        with closing(Ear(robot)) as ear:
            robot.start_operator("alice")
            ear.until("alice", "ENGAGED")
            robot.start_operator("bob")
            until(lambda: "refused, alice holds it" in robot.text("bob"), "bob told")
            give = ("lease", "give", str(robot.file), "bob", "--as", "alice")
            assert robot.farhand(*give) == (0, "given to bob\n")
            ear.until("bob", "ENGAGED")
            robot.end("bob")
            ear.until("alice", "ENGAGED")
        seals = [line for line in robot.text("remote").splitlines() if "packets are" in line]
        assert [line.partition("packets are sealed with ")[2] for line in seals] == [
            "operator.alice-1",
            "operator.bob-1",
            "operator.alice-1",
        ]
        for name in ("alice", "bob"):  # who waits is not told of packets that are for others
            assert "refused: " not in robot.text(name).replace("lease: refused", "")
            assert "opened anew" not in robot.text(name)


class Heard(DaemonLog):
    """Keeps what is said."""

    def __init__(self, said: list[str]) -> None:
        super().__init__("test")
        self.said = said

    def say(self, text: str, level: Level = "INFO") -> None:
        self.said.append(text)


class Relay:
    """A relay in wrong hands: hears what one site offers, and offers the remote what it likes.

    With the relay's own certificate, which is all that the remote site's connection asks for.
    """

    def __init__(self, folder: Path, authority: Authority) -> None:
        self.keys = authority.folder
        place = f"tls/127.0.0.1:{free_port()}"
        packets = f"udp/127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
        self.file = write_session(
            folder / "session.toml", self.keys, router=place, packets_connect=packets
        )
        self.session = load_session(self.file)
        self._stack = ExitStack()
        enter, ended = self._stack.enter_context, closing
        trust = tls(self.keys / "router")
        self.node = enter(ended(ZenohNode(ZenohSettings(listen=(place,), configuration=trust))))
        enter(ended(ZenohNode(ZenohSettings(listen=(packets,)))))
        self.say = self.node.publisher(offer_key(NAME, LOCAL))
        self.said: list[str] = []
        self.seal = self.site(REMOTE, self.said)

    def site(self, site: SiteId, said: list[str]) -> SealKeeper:
        meeting: Meeting = meet_as_site(self.session, site)
        enter = self._stack.enter_context
        node = enter(closing(ZenohNode(meeting.settings)))
        assert meeting.packets is not None
        packets = enter(closing(ZenohNode(meeting.packets)))
        seal = SealKeeper(
            self.session, site, meeting, time.time_ns(), node, packets, SteadyClock(),
            OperatorRequests(), Heard(said),
        )  # fmt: skip
        return enter(seal)

    def offer(self, folder: Path, name: str, digest: int | None = None) -> bytes:
        """What whoever holds the keys in a folder can offer in the local site's place."""
        credentials = read_credentials(folder, Identity(name))
        used = self.session.digest if digest is None else digest
        return OwnOffer(LOCAL, credentials, used, time.time_ns()).payload

    def until_said(self, payload: bytes, words: str) -> None:
        until(lambda: self.say(payload) or any(words in text for text in self.said), words)

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[Relay]:
    with closing(Relay(tmp_path, make_keys(tmp_path / "keys"))) as relay:
        yield relay


@pytest.mark.parametrize(
    ("thief", "words"),
    [
        ("another authority", "another authority"),
        ("dashboard", "the certificate of observer.dashboard-1, not of local-1"),
        ("router", "the certificate of router-1, not of local-1"),
        ("another session", "another session file"),
        ("swapped key", "not signed by its certificate's key"),
        ("reflected", "the certificate of remote-1, not of local-1"),
    ],
)
def test_a_relay_cannot_put_itself_in_between(
    relay: Relay, thief: str, words: str, tmp_path: Path
) -> None:
    genuine = relay.offer(relay.keys, "local")
    if thief == "another authority":
        make_keys(tmp_path / "other")
        payload = relay.offer(tmp_path / "other", "local")
    elif thief == "another session":
        payload = relay.offer(relay.keys, "local", digest=1)
    elif thief == "swapped key":
        changed = bytearray(genuine)
        changed[PUBLIC] = X25519PrivateKey.generate().public_key().public_bytes_raw()
        payload = bytes(changed)
    elif thief == "reflected":
        ear, heard = relay.node.subscriber(offer_key(NAME, REMOTE), 10), []
        until(lambda: heard.extend(payloads(ear)) or bool(heard), "the site's own offer")
        payload = heard[0]
    else:
        payload = relay.offer(relay.keys, thief)
    relay.until_said(payload, words)
    assert relay.seal.link.keys is None
    relay.until_said(genuine, "packets are sealed with local-1")  # the control: it was heard


def test_a_revoked_certificate_offers_in_vain(tmp_path: Path) -> None:
    authority = make_keys(tmp_path / "keys")
    stolen = shutil.copytree(authority.folder / "local", tmp_path / "stolen" / "local").parent
    with closing(Relay(tmp_path, authority)) as relay:
        relay.until_said(relay.offer(stolen, "local"), "packets are sealed with local-1")
    authority.revoke(Identity("local"))
    authority.issue(Identity("local"), LOOPBACK)
    with closing(Relay(tmp_path, authority)) as relay:
        relay.until_said(relay.offer(stolen, "local"), "the certificate of local-1, not of local-2")
        assert relay.seal.link.keys is None
        relay.until_said(relay.offer(relay.keys, "local"), "packets are sealed with local-2")
