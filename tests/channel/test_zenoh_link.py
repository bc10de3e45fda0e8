"""What is Zenoh's alone: nodes, telemetry, errors. The link itself is tests/contracts/test_link."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from channel.link import LinkError
from channel.zenoh_link import ZenohNode, ZenohSettings, _config, _ports
from tests.ports import free_port


def until(condition: Callable[[], bool], deadline_s: float = 20.0) -> None:
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, "not within the deadline"
        time.sleep(0.001)


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def nodes(endpoint: str) -> Iterator[tuple[ZenohNode, ZenohNode]]:
    listening = ZenohNode(ZenohSettings(listen=(endpoint,)))
    connecting = ZenohNode(ZenohSettings(connect=(endpoint,)))
    yield listening, connecting
    connecting.close()
    listening.close()


def test_telemetry_reaches_a_subscriber_of_a_whole_branch(
    nodes: tuple[ZenohNode, ZenohNode],
) -> None:
    site, viewer = nodes
    subscription = viewer.subscriber("session/**", capacity=16)
    publish = site.publisher("session/local/rows")
    payload = bytes(range(256)) * 800  # 200 kB: many fragments
    arrived: list[tuple[str, bytes]] = []

    def heard() -> bool:
        publish(payload)
        arrived.extend(subscription.receive())
        return bool(arrived)

    until(heard)
    assert arrived[0] == ("session/local/rows", payload)
    subscription.close()
    subscription.close()
    assert subscription.receive() == []


def test_a_link_is_turned_from_one_peer_to_another_and_to_none(
    nodes: tuple[ZenohNode, ZenohNode],
) -> None:
    here = nodes[0].link("session/remote", None)
    peers = {name: nodes[1].link(f"session/{name}", "session/remote") for name in "ab"}

    def heard() -> set[bytes]:
        for name, peer in peers.items():
            peer.send(name.encode())
        return set(here.receive())

    assert not here.peer_present()
    assert heard() == set()
    for name in "aba":
        here.listen_to(f"session/{name}")
        until(lambda name=name: heard() == {name.encode()})
        until(here.peer_present)
        for _ in range(20):
            assert heard() <= {name.encode()}
        here.listen_to(None)
        for _ in range(20):
            assert heard() == set()
        assert not here.peer_present()
    here.listen_to("session/b")
    nodes[0].reopen()
    until(lambda: heard() == {b"b"})
    nodes[0].close()
    here.listen_to("session/a")  # too late, and no error
    assert heard() == set()


@pytest.mark.parametrize("which", [0, 1])
def test_a_node_that_opens_anew_is_heard_and_hears_while_its_loop_goes_on(
    nodes: tuple[ZenohNode, ZenohNode], which: int
) -> None:
    node, other = nodes[which], nodes[1 - which]
    here, there = node.link("session/a", "session/b"), other.link("session/b", "session/a")
    tell, told = node.publisher("session/rows"), other.subscriber("session/rows", 1000)
    over, heard, errors = threading.Event(), [], []

    def loop() -> None:
        while not over.is_set():
            try:
                here.send(b"from here")
                tell(b"row")
                heard.extend(here.receive())
                time.sleep(1e-4)
            except Exception as error:
                errors.append(error)
                return

    thread = threading.Thread(target=loop)
    thread.start()
    for round_ in range(3):
        node.reopen()
        there.receive(), told.receive()
        word = f"round {round_}".encode()
        until(lambda word=word: there.send(word) and word in heard)
        until(lambda: b"from here" in there.receive())
        until(lambda: bool(told.receive()))
        until(there.peer_present)
        until(here.peer_present)
    over.set()
    thread.join()
    assert errors == []
    node.close()
    node.reopen()
    assert not here.send(b"over")
    assert here.receive() == []


def test_what_a_node_dials_shows_while_it_is_connected(
    nodes: tuple[ZenohNode, ZenohNode], endpoint: str
) -> None:
    listening, connecting = nodes
    until(connecting.dialled)
    assert not listening.dialled()  # what it accepts is not its to open
    beyond = ZenohNode(ZenohSettings(connect=(endpoint, "tcp/127.0.0.1:1")))
    link, other = beyond.link("session/c", "session/a"), listening.link("session/a", "session/c")
    until(lambda: link.send(b"connected") and other.receive() != [])
    assert not beyond.dialled()  # not all of it
    beyond.close()
    assert not beyond.dialled()
    listening.close()
    until(lambda: not connecting.dialled())


@pytest.mark.parametrize(
    ("text", "ports"),
    [
        ('["tcp/192.168.1.2:7447","udp/[::1]:7448?rel=0#iface=a:9"]', {"7447", "7448"}),
        ('{"router":["tls/host.example:1"],"peer":[]}', {"1"}),
        ("tcp/[fe80::12:34]:48164", {"48164"}),
        ('["unixsock-stream/a/b"]', set()),
    ],
)
def test_ports_of_endpoints(text: str, ports: set[str]) -> None:
    assert _ports(text) == ports


def test_who_is_dialled_is_waited_for_longer_than_who_dials() -> None:
    """Else both ends of a dead connection give it up at once, and the next may be lost in it."""
    leases = [
        int(_config(ZenohSettings(listen=("tcp/127.0.0.1:0",), lease_ms=500, tier=tier)).get_json(
            "transport/link/tx/lease"
        ))
        for tier in range(3)
    ]  # fmt: skip
    assert leases == [500, 625, 750]


def test_a_run_that_ends_late_does_not_hide_its_successor(
    nodes: tuple[ZenohNode, ZenohNode], endpoint: str
) -> None:
    listening, first_run = nodes
    link = listening.link("s/local", "s/remote")
    old = first_run.link("s/remote", "s/local")
    until(link.peer_present)
    second_run = ZenohNode(ZenohSettings(connect=(endpoint,)))
    new = second_run.link("s/remote", "s/local")
    until(new.peer_present)
    until(lambda: link.peer_present() and len(link._present) == 2)
    old.close()
    until(lambda: (link.peer_present(), len(link._present))[1] == 1)
    assert link.peer_present()
    second_run.close()
    until(lambda: not link.peer_present())


def test_everything_on_a_closed_node_is_quiet(endpoint: str) -> None:
    node = ZenohNode(ZenohSettings(listen=(endpoint,)))
    link, publish = node.link("a", "b"), node.publisher("c")
    subscription = node.subscriber("d", 1)
    node.close()
    node.close()
    publish(b"x")
    assert not link.send(b"x")
    assert link.receive() == []
    assert not link.peer_present()
    assert subscription.receive() == []
    link.close()
    with pytest.raises(LinkError, match="declare"):
        node.link("a", "b")


def test_a_taken_port_is_named(endpoint: str) -> None:
    node = ZenohNode(ZenohSettings(listen=(endpoint,)))
    with pytest.raises(LinkError, match=endpoint) as raised:
        ZenohNode(ZenohSettings(listen=(endpoint,)))
    assert "in use" in str(raised.value)
    assert "a port no other program has" in str(raised.value)
    node.close()


@pytest.mark.parametrize("bad", ["nonsense", "tcp/127.0.0.1:port"])
def test_a_bad_endpoint_is_named(bad: str) -> None:
    with pytest.raises(LinkError, match=bad):
        ZenohNode(ZenohSettings(listen=(bad,)))


def test_an_unreachable_peer_is_no_error() -> None:
    ZenohNode(ZenohSettings(connect=("tcp/127.0.0.1:1",))).close()


def test_nowhere_to_meet_is_an_error() -> None:
    with pytest.raises(LinkError, match="nowhere to meet"):
        ZenohNode(ZenohSettings())


def test_a_users_own_configuration_is_used(tmp_path: Path, endpoint: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        '{mode: "peer", scouting: {multicast: {enabled: false}}, '
        f'listen: {{endpoints: ["{endpoint}"]}}}}'
    )
    own = ZenohNode(ZenohSettings(config_file=str(file)))
    other = ZenohNode(ZenohSettings(connect=(endpoint,)))
    link = own.link("a", "b")
    other.link("b", "a")
    until(link.peer_present)
    other.close()
    own.close()


def test_given_endpoints_override_the_users_configuration(tmp_path: Path, endpoint: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text('{mode: "peer", listen: {endpoints: ["tcp/192.0.2.1:7447"]}}')
    with pytest.raises(LinkError):
        ZenohNode(ZenohSettings(config_file=str(file)))
    ZenohNode(ZenohSettings(listen=(endpoint,), config_file=str(file))).close()


def test_a_missing_or_broken_configuration_file_is_named(tmp_path: Path) -> None:
    missing = tmp_path / "missing.json5"
    with pytest.raises(LinkError, match="does not exist"):
        ZenohNode(ZenohSettings(config_file=str(missing)))
    broken = tmp_path / "broken.json5"
    broken.write_text("{listen: ")
    with pytest.raises(LinkError, match="broken"):
        ZenohNode(ZenohSettings(config_file=str(broken)))


def test_lease_must_be_positive() -> None:
    with pytest.raises(ValueError, match="lease_ms = 0"):
        ZenohSettings(lease_ms=0)
