import itertools
import struct
import threading

import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from hypothesis import given
from hypothesis import strategies as st

from channel.memory_link import MemoryLink, memory_links
from channel.sealed_link import OVERHEAD_BYTES, VERSION, PacketKeys, Refusal, SealedLink

THERE, BACK = bytes(range(36)), bytes(range(36, 72))
OTHER = bytes(range(72, 108))


def pair() -> tuple[SealedLink, SealedLink, MemoryLink]:
    """Two ends that share keys; the last is what the second one's carrier receives from."""
    mine, theirs = memory_links(1000)
    first, second = SealedLink(mine, mine.peer_present), SealedLink(theirs, theirs.peer_present)
    first.use(PacketKeys(THERE, BACK))
    second.use(PacketKeys(BACK, THERE))
    return first, second, mine


def sealed(*datagrams: bytes) -> list[bytes]:
    """What a first end sends."""
    mine, theirs = memory_links(1000)
    first = SealedLink(mine, mine.peer_present)
    first.use(PacketKeys(THERE, BACK))
    for data in datagrams:
        assert first.send(data)
    return theirs.receive()


@given(st.lists(st.binary(max_size=200), max_size=5))
def test_what_is_sealed_is_opened_and_cannot_be_read_on_the_way(datagrams: list[bytes]) -> None:
    first, second, _ = pair()
    for data in datagrams:
        first.send(data)
    assert second.receive() == datagrams
    assert second.opened == len(datagrams)
    assert second.refused.total() == 0
    for data, on_the_way in zip(datagrams, sealed(*datagrams), strict=True):
        assert len(on_the_way) == len(data) + OVERHEAD_BYTES
        assert len(data) < 8 or data not in on_the_way


def test_the_same_twice_looks_different() -> None:
    one, other = sealed(bytes(100), bytes(100))
    assert one[13:-16] != other[13:-16]


def test_a_datagram_is_what_the_docs_say() -> None:
    """Version, key id, sequence; then the packet and a tag, all of them under the tag."""
    _, datagram = sealed(b"one", b"a pose")
    head = bytes([1]) + THERE[:4] + bytes(7) + b"\2"
    assert datagram[:13] == head
    cipher = ChaCha20Poly1305(THERE[4:])
    assert cipher.decrypt(bytes(11) + b"\2", datagram[13:], head) == b"a pose"


@given(st.binary(min_size=1, max_size=150), st.data())
def test_whatever_bit_is_changed_it_is_refused(plain: bytes, data: st.DataObject) -> None:
    (datagram,) = sealed(plain)
    bit = data.draw(st.integers(0, 8 * len(datagram) - 1))
    changed = bytearray(datagram)
    changed[bit // 8] ^= 1 << bit % 8
    _, second, carrier = pair()
    carrier.send(bytes(changed))
    assert second.receive() == []
    expected = Refusal.TAG
    if bit < 8:
        expected = Refusal.MALFORMED
    elif bit < 40:
        expected = Refusal.KEY
    elif changed[5:13] == bytes(8):
        expected = Refusal.REPLAY  # sequence zero is never sent
    assert +second.refused == {expected: 1}
    carrier.send(datagram)  # and spoils nothing
    assert second.receive() == [plain]


@given(st.binary(max_size=100))
def test_garbage_is_refused(data: bytes) -> None:
    _, second, carrier = pair()
    carrier.send(data)
    carrier.send(bytes([VERSION]) + THERE[:4] + struct.pack(">Q", 5) + data)
    assert second.receive() == []
    assert second.refused.total() == 2


@given(st.permutations(range(6)), st.lists(st.integers(0, 5), max_size=4))
def test_nothing_is_opened_twice_nor_after_a_newer_one(order: list[int], again: list[int]) -> None:
    datagrams = sealed(*(bytes([k]) for k in range(6)))
    _, second, carrier = pair()
    arrivals = [*order, *again]
    for k in arrivals:
        carrier.send(datagrams[k])
    opened = [data[0] for data in second.receive()]
    newer = list(dict.fromkeys(itertools.accumulate(arrivals, max)))
    assert opened == newer
    assert second.refused[Refusal.REPLAY] == len(arrivals) - len(newer)


def test_one_s_own_datagrams_do_not_come_back() -> None:
    _, second, carrier = pair()
    second.send(b"a pose")
    carrier.send(carrier.receive()[0])
    assert second.receive() == []
    assert second.refused[Refusal.KEY] == 1


def test_without_keys_nothing_passes() -> None:
    first, second, carrier = pair()
    second.use(None)
    assert not second.send(b"x")
    assert carrier.receive() == []
    first.send(b"y")
    assert second.receive() == []
    assert second.refused[Refusal.KEY] == 1
    second.use(PacketKeys(BACK, THERE))
    first.send(b"z")
    assert second.receive() == [b"z"]


def test_keys_that_come_back_open_nothing_again_and_see_no_nonce_twice() -> None:
    first, second, carrier = pair()
    mine, theirs = first.keys, second.keys
    first.send(b"one")
    kept = carrier._outbox[0]
    assert second.receive() == [b"one"]
    for end, keys in ((first, PacketKeys(OTHER, BACK)), (second, PacketKeys(BACK, OTHER))):
        end.use(keys)
    first.send(b"two")
    assert second.receive() == [b"two"]
    first.use(mine)
    second.use(theirs)
    carrier.send(kept)
    assert second.receive() == []
    assert second.refused[Refusal.REPLAY] == 1
    first.send(b"three")
    assert carrier._outbox[0][5:13] == struct.pack(">Q", 3)
    assert second.receive() == [b"three"]


def test_keys_change_under_a_loop_that_goes_on() -> None:
    first, second, _ = pair()
    every = [
        (PacketKeys(THERE, BACK), PacketKeys(BACK, THERE)),
        (PacketKeys(OTHER, BACK), PacketKeys(BACK, OTHER)),
    ]
    over = threading.Event()

    def change() -> None:
        for mine, theirs in itertools.cycle(every):
            if over.is_set():
                return
            second.use(theirs)
            first.use(mine)
            first.use(None)

    thread = threading.Thread(target=change)
    thread.start()
    arrived: list[bytes] = []
    try:
        k = 0
        while len(arrived) < 2000 and k < 10_000_000:
            k += 1
            first.send(k.to_bytes(4, "big"))
            arrived += second.receive()
    finally:
        over.set()
        thread.join()
    assert len(arrived) >= 2000
    assert arrived == sorted(set(arrived))
    assert second.refused[Refusal.TAG] == second.refused[Refusal.MALFORMED] == 0


def test_a_closed_end_is_quiet() -> None:
    first, second, _ = pair()
    assert first.peer_present()
    second.close()
    second.close()
    assert not second.send(b"x")
    assert second.receive() == []
    assert not first.peer_present()


@pytest.mark.parametrize("wrong", [b"", bytes(32), bytes(37)])
def test_a_key_has_its_length(wrong: bytes) -> None:
    with pytest.raises(ValueError, match="36"):
        PacketKeys(wrong, THERE)
