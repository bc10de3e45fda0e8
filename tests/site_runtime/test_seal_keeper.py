"""Keys for sealed packets between two sites: real nodes and certificates, time by hand."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest

from channel.channel import Counters
from channel.sealed_link import Refusal
from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.clock import ManualClock
from site_runtime.daemon_log import DaemonLog
from site_runtime.keys import SiteId, state_key
from site_runtime.operator_requests import OperatorRequests
from site_runtime.seal_keeper import WARN_NS, SealedLinkKeeper, SealKeeper
from site_runtime.security.authority import Authority
from site_runtime.security.identity import SITES, Identity
from site_runtime.security.network import meet_as_site
from site_runtime.session import Session, load_session
from telemetry.events import Level
from tests.loopback.secured import LOOPBACK, NAME, make_keys, until, write_session
from tests.ports import free_port

pytestmark = pytest.mark.patient
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
S = 1_000_000_000


class Heard(DaemonLog):
    """Keeps what is said."""

    def __init__(self, said: list[tuple[str, str]]) -> None:
        super().__init__("test")
        self.said = said

    def say(self, text: str, level: Level = "INFO") -> None:
        self.said.append((level, text))


class End:
    """One run of a site, its link and what it said."""

    def __init__(self, place: "Place", site: SiteId, operator: str | None, epoch: int) -> None:
        listen = None if site is REMOTE else [f"tls/127.0.0.1:{free_port()}"]
        self._place = place
        meeting = meet_as_site(place.session, site, listen, operator=operator)
        assert meeting.packets is not None
        self._stack = ExitStack()
        self.node = self._stack.enter_context(closing(ZenohNode(meeting.settings)))
        self.packets = self._stack.enter_context(closing(ZenohNode(meeting.packets)))
        self.said: list[tuple[str, str]] = []
        self.requests = OperatorRequests()
        self.seal = SealKeeper(
            place.session, site, meeting, epoch, self.node, self.packets, place.clock,
            self.requests, Heard(self.said),
        )  # fmt: skip
        self.link = self.seal.link
        place.ends.append(self)

    def heard(self) -> set[bytes]:
        return set(self.link.receive())

    def warnings(self) -> list[str]:
        return [text for level, text in self.said if level == "WARN"]

    def close(self) -> None:
        if self in self._place.ends:
            self._place.ends.remove(self)
            self._stack.close()


class Place:
    """Where ends meet without a relay; `look` lets all of them look, a quarter of a second on."""

    def __init__(self, folder: Path, *names: str) -> None:
        self.authority: Authority = make_keys(
            folder / "keys", [Identity(name) for name in (*names, "remote")]
        )
        place = f"tls/127.0.0.1:{free_port()}"
        self.udp = f"udp/127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
        self.session: Session = load_session(
            write_session(
                folder / "session.toml",
                self.authority.folder,
                remote_listen=place,
                local_connect=place,
                packets_listen=self.udp,
                packets_connect=self.udp,
            )
        )
        self.clock = ManualClock(10 * S)
        self.ends: list[End] = []

    def end(self, site: SiteId, operator: str | None = None, epoch: int = 1) -> End:
        return End(self, site, operator, epoch)

    def look(self) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + S // 4)
        for end in self.ends:
            end.seal.look()

    def until(self, condition: Callable[[], object], what: str) -> None:
        until(lambda: bool((self.look(), condition())[1]), what, 30.0)

    def until_sealed(self, *ends: End) -> None:
        self.until(lambda: all(end.link.keys is not None for end in ends), "keys")

    def until_hears(self, hearer: End, speaker: End, word: bytes) -> None:
        """Until one end has opened what the other sends; packets come more often than looks."""

        def heard() -> bool:
            speaker.link.send(word)
            time.sleep(0.01)
            return word in hearer.heard()

        self.until(heard, f"{word!r}")

    def close(self) -> None:
        for end in list(self.ends):
            end.close()


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    with closing(Place(tmp_path, "local")) as place:
        yield place


def test_two_sites_seal_for_each_other_and_tell_with_whom(place: Place) -> None:
    remote, local = place.end(REMOTE), place.end(LOCAL)
    assert not local.link.send(b"too early")
    assert not local.link.peer_present()
    place.until_sealed(remote, local)
    assert (remote.said, local.said) == (
        [("INFO", "packets are sealed with local-1")],
        [("INFO", "packets are sealed with remote-1")],
    )
    place.until_hears(remote, local, b"there")
    place.until_hears(local, remote, b"back")
    assert local.link.peer_present()
    remote.close()
    for _ in range(13):
        place.look()
    assert not local.link.peer_present()


def test_a_run_that_was_restarted_gets_new_keys_and_the_old_ones_open_nothing(
    place: Place,
) -> None:
    remote, first = place.end(REMOTE), place.end(LOCAL, epoch=1)
    place.until_sealed(remote, first)
    place.until_hears(remote, first, b"first")
    before = first.link.keys
    first.close()
    second = place.end(LOCAL, epoch=2)
    place.until_hears(remote, second, b"second")
    place.until_hears(second, remote, b"answer")
    second.link.use(before)
    second.link.send(b"of the run before")
    until(lambda: remote.link.receive() == [] and remote.link.refused[Refusal.KEY] > 0, "refused")


def test_a_second_run_waits_until_the_first_is_silent_and_is_then_not_replaced_by_it(
    place: Place,
) -> None:
    remote, first = place.end(REMOTE), place.end(LOCAL, epoch=1)
    place.until_hears(remote, first, b"first")
    second = place.end(LOCAL, epoch=2)
    place.until_sealed(second)
    for _ in range(20):
        first.link.send(b"first")
        second.link.send(b"second")
        time.sleep(0.02)
        assert b"second" not in remote.heard()
        place.look()
    place.until_hears(remote, second, b"second")
    told = "a key offered in the name of local-1 is refused: it is of an earlier run"
    place.until(lambda: told in remote.warnings(), "the first refused")  # the second is silent now
    place.until_hears(remote, second, b"second again")


def test_packets_end_with_the_certificate(place: Place) -> None:
    place.authority.issue(SITES[LOCAL], LOOPBACK, life=timedelta(seconds=6))
    remote, local = place.end(REMOTE), place.end(LOCAL)
    place.until_hears(remote, local, b"in time")
    place.until(lambda: remote.link.keys is None, "its end")
    assert "the certificate local-1 has expired: its packets end" in remote.warnings()
    assert not remote.link.send(b"x")
    for _ in range(8):  # what is still offered does not bring it back
        place.look()
        time.sleep(0.02)
    assert remote.link.keys is None


def test_what_is_refused_is_counted_and_told_now_and_then(place: Place) -> None:
    remote, local = place.end(REMOTE), place.end(LOCAL)
    place.until_hears(remote, local, b"there")
    with closing(ZenohNode(ZenohSettings(connect=(place.udp,)))) as intruder:
        say = intruder.publisher(state_key(NAME, LOCAL))

        def refuse(count: int) -> None:
            """Let the site refuse so many."""
            goal = remote.link.refused[Refusal.MALFORMED] + count
            until(lambda: bool(intruder.partners()), "a connection")
            while remote.link.refused[Refusal.MALFORMED] < goal:
                say(b"forged")
                time.sleep(0.01)
                remote.link.receive()

        refuse(3)
        place.look()
        assert [text for text in remote.warnings() if "refused" in text] == [
            f"sealed packets refused: {remote.link.refused[Refusal.MALFORMED]} malformed"
        ]
        told_ns = place.clock.now_ns()
        refuse(2)
        while place.clock.now_ns() + S // 4 < told_ns + WARN_NS:
            place.look()
        assert len([text for text in remote.warnings() if "refused" in text]) == 1
        place.look()
        assert len([text for text in remote.warnings() if "refused" in text]) == 2


def test_udp_that_does_not_pass_is_told_of_once(place: Place) -> None:
    remote, local = place.end(REMOTE), place.end(LOCAL)
    place.until_sealed(remote, local)
    for _ in range(20):
        place.look()
        time.sleep(0.02)
    expected = "nothing that local-1 has sealed arrives: is UDP let through to"
    assert [text.startswith(expected) for text in remote.warnings()] == [True]
    place.until_hears(remote, local, b"there")
    assert len(remote.warnings()) == 1


def test_a_peer_that_seals_nothing_is_told_of(place: Place) -> None:
    """Its session file has no word of packets."""
    remote = place.end(REMOTE)
    listen = [f"tls/127.0.0.1:{free_port()}"]
    with closing(ZenohNode(meet_as_site(place.session, LOCAL, listen).settings)):
        place.until(lambda: remote.warnings(), "a warning")
    assert "local-1 is connected and offers no key" in remote.warnings()[0]


def test_of_several_people_who_holds_the_robot_has_the_packets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Place(tmp_path, "operator.alice", "operator.bob")) as place:
        remote = place.end(REMOTE)
        people = {name: place.end(LOCAL, name) for name in ("alice", "bob")}
        place.until_sealed(*people.values())
        assert remote.link.keys is None
        assert not remote.link.send(b"for nobody")
        kept = None
        while_turning = []
        turn = remote.seal._link.listen_to
        monkeypatch.setattr(
            remote.seal._link,
            "listen_to",
            lambda key: (while_turning.append(remote.link.keys), turn(key)),
        )
        for name in ("alice", "bob", "alice"):
            remote.seal.listen_to(state_key(NAME, LOCAL, name))
            other = "bob" if name == "alice" else "alice"
            place.until_hears(remote, people[name], name.encode())
            place.until_hears(people[name], remote, b"for " + name.encode())
            assert people[other].heard() == set()
            people[other].link.send(b"unasked")
            time.sleep(0.1)
            assert b"unasked" not in remote.heard()
            kept = remote.link.keys if kept is None else kept
        assert remote.link.keys is kept  # with the memory of what it has opened
        remote.seal.listen_to(None)
        assert while_turning == [None] * 4  # else it may go on speaking to the one before
        assert not remote.link.send(b"for nobody")


def test_who_waits_for_the_lease_is_not_told_of_packets_for_others(tmp_path: Path) -> None:
    with closing(Place(tmp_path, "operator.alice", "operator.bob")) as place:
        remote = place.end(REMOTE)
        alice, bob = (place.end(LOCAL, name) for name in ("alice", "bob"))
        bob.requests.unleased = True
        place.until_sealed(alice, bob)
        remote.seal.listen_to(state_key(NAME, LOCAL, "alice"))
        place.until_hears(alice, remote, b"for alice")
        place.until(
            lambda: (remote.link.send(b"x"), bob.heard(), bob.link.refused[Refusal.KEY] > 5)[2],
            "refused",
        )
        for _ in range(40):
            remote.link.send(b"for alice")
            bob.heard(), alice.heard()
            place.look()
        assert bob.warnings() == []
        bob.requests.unleased = False  # the control
        place.until(lambda: (remote.link.send(b"x"), bob.heard(), bob.warnings())[2], "a warning")
        place.until(
            lambda: any("under no key in use" in text for text in bob.warnings()), "the other"
        )


def test_either_node_s_silence_has_both_opened_anew_but_not_while_others_hold_the_robot(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    remote, local = place.end(REMOTE), place.end(LOCAL)
    place.until_hears(local, remote, b"back")
    opened_s: list[float] = []
    monkeypatch.setattr(local.seal, "reopen", lambda: opened_s.append(place.clock.now_ns() / S))
    channel = SimpleNamespace(
        counters=Counters(),
        heard_ns=None,
        echoed_ns=None,
        peer_taken=False,
    )
    site = SimpleNamespace(channel=channel, requests=local.requests)
    keeper = SealedLinkKeeper(site, local.seal, place.clock, DaemonLog("local"))  # type: ignore[arg-type]

    def opened(*, echoes: bool, offers: bool = True) -> int:
        """Let ten seconds pass; how often was it opened anew?"""
        opened_s.clear()
        for _ in range(40):
            if offers:
                place.look()
                time.sleep(0.01)
            else:
                place.clock.sleep_until_ns(place.clock.now_ns() + S // 4)
            if echoes:
                channel.echoed_ns = place.clock.now_ns()
            keeper.look()
        return len(opened_s)

    assert opened(echoes=True) == 0
    assert opened(echoes=True, offers=False) > 0  # telemetry and the lease would be dead
    assert opened(echoes=True) == 0
    assert opened(echoes=False) > 0
    local.requests.unleased = True
    opened(echoes=False)
    assert opened(echoes=False) == 0
    local.requests.unleased = False
    opened(echoes=True)
    remote.packets.close()
    until(lambda: not local.packets.dialled(), "gone")
    assert opened(echoes=False) == 0  # an outage is waited out


def test_both_nodes_are_opened_anew_and_packets_flow_again(place: Place) -> None:
    remote, local = place.end(REMOTE), place.end(LOCAL)
    place.until_hears(remote, local, b"before")
    partners = {node: set(node.partners()) for node in (remote.node, remote.packets)}
    local.seal.reopen()
    place.until(lambda: local.seal.dialled(), "both connected")
    place.until_hears(remote, local, b"after")
    place.until_hears(local, remote, b"and back")
    assert set(remote.packets.partners()) != partners[remote.packets]  # from another port
