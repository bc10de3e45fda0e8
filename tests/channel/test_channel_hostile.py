"""A channel in a live exchange, and somebody else's datagrams in between."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.channel import Channel
from channel.delay import ConstantDelay, Direction, SinusoidDelay
from channel.memory_link import memory_links
from channel.packet import Reject
from tests.fuzz.exchange import DIMENSION, MS, Exchange, knowledge, listener, used
from tests.fuzz.layout import BY_NAME, FIELDS, VECTORS_OFFSET, example, overwritten, resealed

LEAST, MOST = -(2**63), 2**63 - 1
CHANNELS: dict[str, dict[str, Any]] = {
    "off": {},
    "shared clock": {"shared_clock": True},
    "exact": {"direction": Direction(ConstantDelay(0.01)), "mode": "exact"},
    "added": {"direction": Direction(SinusoidDelay(0.01, 0.01, 50.0)), "mode": "added"},
}


def forged(data: bytes, **changes: int) -> bytes:
    """The packet with other fields and its checksum repaired."""
    for name, value in changes.items():
        data = BY_NAME[name].written(data, value)
    return resealed(data)


def with_vectors(data: bytes, value: float) -> bytes:
    numbers = np.full(3 * DIMENSION, value, dtype="<f8").tobytes()
    return resealed(overwritten(data, VECTORS_OFFSET, numbers))


def ahead(data: bytes, **changes: int) -> bytes:
    """As if the peer's next but for the changes: were these let through, it would be used."""
    later = {
        "sequence": BY_NAME["sequence"].read(data) + 1,
        "stamp_ns": BY_NAME["stamp_ns"].read(data) + MS // 2,
    }
    return forged(data, **(later | changes))


Make = Callable[[bytes, list[bytes], list[bytes]], bytes]  # of the newest, all heard, all said
HOSTILE: list[tuple[str, Reject, Make]] = [
    ("another session", Reject.SESSION, lambda new, *_: ahead(new, session=1)),
    ("the least session", Reject.SESSION, lambda new, *_: ahead(new, session=0)),
    ("my own site", Reject.SITE, lambda new, *_: ahead(new, site=0)),
    ("a third site", Reject.SITE, lambda new, *_: ahead(new, site=2)),
    ("my own words", Reject.SITE, lambda _, __, said: said[-1]),
    ("another run", Reject.EPOCH, lambda new, *_: ahead(new, epoch=7)),
    ("no run at all", Reject.EPOCH, lambda new, *_: ahead(new, epoch=0)),
    (
        "another run that answers nobody",
        Reject.EPOCH,
        lambda new, *_: ahead(new, epoch=7, echo_epoch=0),
    ),
    ("the newest again", Reject.DUPLICATE, lambda new, *_: new),
    ("the newest, other words", Reject.DUPLICATE, lambda new, *_: with_vectors(new, 9.0)),
    ("the newest, the last stamp", Reject.DUPLICATE, lambda new, *_: forged(new, stamp_ns=MOST)),
    ("the first again", Reject.OUT_OF_ORDER, lambda _, heard, __: heard[0]),
    ("one of a moment ago", Reject.OUT_OF_ORDER, lambda _, heard, __: heard[-5]),
    ("sequence 0", Reject.OUT_OF_ORDER, lambda new, *_: ahead(new, sequence=0)),
    (
        "an old one stamped anew",
        Reject.OUT_OF_ORDER,
        lambda _, heard, __: forged(heard[-9], stamp_ns=MOST),
    ),
    ("the stamp again", Reject.STAMP, lambda new, *_: forged(new, sequence=2**40)),
    ("the least stamp", Reject.STAMP, lambda new, *_: ahead(new, stamp_ns=LEAST)),
    ("stamp -1", Reject.STAMP, lambda new, *_: ahead(new, stamp_ns=-1)),
    (
        "the last sequence, an old stamp",
        Reject.STAMP,
        lambda new, *_: ahead(new, sequence=2**64 - 1, stamp_ns=0),
    ),
    ("NaN", Reject.NON_FINITE, lambda new, *_: with_vectors(ahead(new), math.nan)),
    ("infinity", Reject.NON_FINITE, lambda new, *_: with_vectors(ahead(new), -math.inf)),
    ("three dimensions", Reject.DIMENSION, lambda new, *_: example(3, **fields_of(ahead(new)))),
    ("unsealed", Reject.CHECKSUM, lambda new, *_: BY_NAME["sequence"].written(new, 2**40)),
    ("cut", Reject.LENGTH, lambda new, *_: new[:-1]),
    ("nothing", Reject.LENGTH, lambda *_: b""),
    ("something else", Reject.MAGIC, lambda *_: b"GET / HTTP/1.1\r\n" * 8),
    ("another version", Reject.VERSION, lambda new, *_: resealed(overwritten(new, 4, b"\xff"))),
]
ALONE = [pytest.param(why, make, id=name) for name, why, make in HOSTILE]


def fields_of(data: bytes) -> dict[str, int]:
    return {field.name: field.read(data) for field in FIELDS}


def test_every_reason_is_among_them() -> None:
    assert {why for _, why, _ in HOSTILE} == set(Reject)


@pytest.mark.parametrize(("why", "make"), ALONE)
def test_one_kind_of_hostile_datagram_changes_nothing(why: Reject, make: Make) -> None:
    exchange = Exchange()
    for _ in range(20):
        exchange.tick()
    for count in range(1, 30):
        exchange.speak()
        exchange.listen(after=[make(exchange.heard[-1], exchange.heard, exchange.said)])
        exchange.wait([make(exchange.heard[-1], exchange.heard, exchange.said)])
        assert exchange.shaken.counters.rejected == {why: 2 * count}


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("where", ["before", "after"])
def test_a_mixture_changes_nothing_and_is_counted(channel: str, where: str) -> None:
    exchange = Exchange(**CHANNELS[channel])
    expected: Counter[Reject] = Counter()
    for _ in range(20):
        exchange.tick()
    for _ in range(200):
        # what is made of the newest is made against it: before its successor is said
        if where == "after":
            exchange.speak()
        batch = [make(exchange.heard[-1], exchange.heard, exchange.said) for _, _, make in HOSTILE]
        if where == "before":
            exchange.speak()
        exchange.listen(**{where: batch})
        expected.update(why for _, why, _ in HOSTILE)
        assert exchange.shaken.counters.rejected == expected
    assert exchange.shaken.counters.received == len(exchange.heard)


def test_another_session_is_told_to_people_and_changes_nothing_else() -> None:
    exchange = Exchange()
    exchange.speak()
    exchange.listen(after=[ahead(exchange.heard[-1], session=1)])
    assert exchange.shaken.other_session is not None
    assert exchange.quiet.other_session is None


def test_a_silent_peer_is_not_woken_by_its_recording() -> None:
    """Its own words again, in order: none is newer than what was heard."""
    exchange = Exchange()
    for _ in range(100):
        exchange.tick()
    sender, own = memory_links(1024)
    channel = listener(own)
    for data in exchange.heard:
        sender.send(data)
    channel.latest(exchange.now_ns)
    for tick in range(1, 2000):
        for data in exchange.heard[tick % 50 :]:
            sender.send(data)
        channel.latest(exchange.now_ns + tick * MS)
        assert channel.heard_ns == exchange.now_ns, "and not since"
    assert set(channel.counters.rejected) == {Reject.DUPLICATE, Reject.OUT_OF_ORDER}


GENUINE = Exchange().heard[-1]

# Packets of the right session and run whose values are absurd: a faulty peer, or a forger


@st.composite
def absurd(draw: st.DrawFn) -> bytes:
    """A packet that the byte checks and the session let through, whatever it says."""
    values: dict[str, int] = {}
    for field in FIELDS:
        extremes = st.sampled_from([field.least, field.least + 1, field.most - 1, field.most])
        values[field.name] = draw(
            extremes | st.integers(field.least, field.most) | st.integers(0, min(200, field.most))
        )
    floats = st.sampled_from([0.0, 1e154, -1e308, 1.7976931348623157e308, 5e-324])
    vectors = draw(st.lists(floats, min_size=6, max_size=6))
    kept = draw(st.sets(st.sampled_from(["epoch", "echo_epoch"]))) | {"site", "session"}
    values |= {name: BY_NAME[name].read(GENUINE) for name in kept}
    return example(vectors=np.array(vectors).reshape(3, 2), **values)


def use(channel: Channel, now_ns: int) -> None:
    """Do everything a site and its display do with a channel."""
    sample = channel.latest(now_ns)
    assert used(sample) is None or np.isfinite([sample.position_m, sample.velocity_m_s]).all()
    if sample is not None:
        assert math.isfinite(sample.age_ns * 1e-9)
        assert sample.round_trip_ns is None or math.isfinite(sample.round_trip_ns * 1e-9)
    knowledge(channel)
    rest = np.zeros(DIMENSION)
    assert channel.send(now_ns, 2, rest, rest, rest)


@pytest.mark.parametrize("channel", CHANNELS)
@settings(deadline=None, max_examples=60)
@given(packets=st.lists(st.lists(absurd(), max_size=4), max_size=6), gap_ms=st.integers(1, 60))
def test_no_value_makes_the_channel_raise(
    channel: str, packets: list[list[bytes]], gap_ms: int
) -> None:
    sender, own = memory_links()
    victim = listener(own, **CHANNELS[channel])
    for tick, batch in enumerate(packets):
        for data in batch:
            sender.send(data)
        use(victim, tick * gap_ms * MS)
    use(victim, 10**12)
    counters = victim.counters
    assert counters.received + counters.rejected.total() == sum(map(len, packets))


@pytest.mark.parametrize("stamp_ns", [LEAST, LEAST + MS, MOST])
def test_an_extreme_stamp_leaves_the_channel_able_to_send(stamp_ns: int) -> None:
    """The age of such a sample is beyond what a packet holds."""
    sender, own = memory_links()
    victim = listener(own, shared_clock=True)
    sender.send(forged(GENUINE, stamp_ns=stamp_ns))
    use(victim, MS)
    use(victim, 2 * MS)
    assert victim.counters.sent == 2


@pytest.mark.parametrize("mode", ["exact", "added"])
def test_a_flood_of_future_stamps_does_not_grow_without_end(mode: str) -> None:
    sender, own = memory_links(1024)
    channel = listener(own, direction=Direction(ConstantDelay(0.01)), mode=mode, shared_clock=True)
    held = []
    for sequence in range(1, 40_001):
        sender.send(forged(GENUINE, sequence=sequence, stamp_ns=2**60 + sequence))
        if sequence % 1000 == 0:
            channel.latest(MS)
            held.append(len(channel._injection._stamps) + len(channel._injection._held))
    assert channel.counters.received == 40_000
    assert max(held) < 10_000
