"""The contract of `channel.link.Link`, run on every implementation."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from channel.link import Link, TappedLink
from channel.memory_link import memory_links
from channel.sealed_link import PacketKeys, SealedLink
from channel.zenoh_link import ZenohNode, ZenohSettings
from tests.ports import free_port

pytestmark = pytest.mark.processes

CAPACITY = 8


@dataclass
class Pair:
    first: Link
    second: Link


def until(condition: Callable[[], bool], deadline_s: float = 20.0) -> None:
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, "not within the deadline"
        time.sleep(0.001)


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(params=["memory", "tapped", "sealed", "zenoh"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    if request.param == "memory":
        yield Pair(*memory_links(CAPACITY))
        return
    if request.param == "tapped":
        yield Pair(*(TappedLink(link, lambda _: None) for link in memory_links(CAPACITY)))
        return
    if request.param == "sealed":
        ends = [SealedLink(link, link.peer_present) for link in memory_links(CAPACITY)]
        there, back = bytes(36), bytes(range(36))
        for end, ways in zip(ends, ((there, back), (back, there)), strict=True):
            end.use(PacketKeys(*ways))
        yield Pair(*ends)
        return
    endpoint = free_endpoint()
    listening = ZenohNode(ZenohSettings(listen=(endpoint,)))
    connecting = ZenohNode(ZenohSettings(connect=(endpoint,)))
    links = Pair(
        listening.link("test/first", "test/second", CAPACITY),
        connecting.link("test/second", "test/first", CAPACITY),
    )
    until(lambda: links.first.peer_present() and links.second.peer_present())
    yield links
    connecting.close()
    listening.close()


def test_a_tap_sees_what_arrives_in_the_order_it_arrived() -> None:
    seen: list[bytes] = []
    mine, theirs = memory_links(CAPACITY)
    tapped = TappedLink(mine, seen.extend)
    for data in (b"one", b"two", b"three"):
        theirs.send(data)
        assert tapped.receive() == [data]
    assert tapped.receive() == []
    assert seen == [b"one", b"two", b"three"]


def collect(link: Link, last: bytes) -> list[bytes]:
    arrived: list[bytes] = []

    def complete() -> bool:
        arrived.extend(link.receive())
        return last in arrived

    until(complete)
    return arrived


def test_carries_both_ways(pair: Pair) -> None:
    assert pair.first.send(b"there")
    assert collect(pair.second, b"there") == [b"there"]
    assert pair.second.send(b"back")
    assert collect(pair.first, b"back") == [b"back"]


def test_keeps_the_order(pair: Pair) -> None:
    sent = [bytes([k]) for k in range(CAPACITY)]
    for data in sent:
        assert pair.first.send(data)
    assert collect(pair.second, sent[-1]) == sent


def test_gives_each_datagram_once(pair: Pair) -> None:
    pair.first.send(b"once")
    collect(pair.second, b"once")
    assert pair.second.receive() == []


def test_receives_nothing_without_waiting(pair: Pair) -> None:
    assert pair.first.receive() == []


def test_keeps_the_newest_when_the_ring_overflows(pair: Pair) -> None:
    # nobody reads: the flood goes on until the far ring has surely turned over
    count = 40 * CAPACITY
    for k in range(count):
        pair.first.send(k.to_bytes(4, "little"))
        time.sleep(0.0005)  # paced as a loop would be: a link may drop a flood at the sender
    pair.first.send(b"last")
    # "last" may be dropped too: any link may drop; then send again
    arrived: list[bytes] = []

    def complete() -> bool:
        arrived.extend(pair.second.receive())
        if b"last" in arrived:
            return True
        pair.first.send(b"last")
        return False

    until(complete)
    numbers = [int.from_bytes(data, "little") for data in arrived if data != b"last"]
    assert numbers == sorted(numbers)
    assert len(numbers) <= 2 * CAPACITY, "the ring is not bounded"
    assert all(number >= count // 2 for number in numbers), "the oldest survived"


def test_drops_rather_than_blocks(pair: Pair) -> None:
    # a million bytes a send, nobody reading: a blocking link would never end this
    for _ in range(200):
        pair.first.send(bytes(100_000))


def test_presence_ends_when_the_peer_closes(pair: Pair) -> None:
    assert pair.first.peer_present()
    pair.second.close()
    until(lambda: not pair.first.peer_present())


def test_closed_link_is_quiet_and_closes_again(pair: Pair) -> None:
    pair.first.send(b"unread")
    pair.second.close()
    pair.second.close()
    assert pair.second.send(b"x") is False
    assert pair.second.receive() == []
    assert pair.second.peer_present() is False


def test_sending_to_a_peer_that_left_does_not_raise(pair: Pair) -> None:
    pair.second.close()
    pair.first.send(b"x")
    assert pair.first.receive() == []
