"""A live exchange of two channels, in which one listener hears hostile datagrams in between.

The peer talks to two listeners of the same site and the same run. One hears the peer alone, the
other hostile datagrams too: as long as they stay bit-equal, these have changed nothing.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from channel.channel import Channel, PeerSample
from channel.memory_link import MemoryLink, memory_links
from tests.fuzz.reference import Receiver

MS = 1_000_000
CLOCKS_APART_NS = 7_000_000_123
SITE, PEER = 0, 1
SESSION, DIMENSION = 0x5E55_1011_0123_4567, 2
CAPACITY = 512
_TOLD = [
    name
    for name, member in vars(Channel).items()
    if isinstance(member, property) and name != "other_session"
]


def listener(link: MemoryLink, site: int = SITE, **changes: Any) -> Channel:
    """Return a site's end of the channel."""
    settings: dict[str, Any] = {
        "session_digest": SESSION,
        "epoch": 1000 + site,
        "dimension": DIMENSION,
        "send_period_ns": MS,
        "silence_ns": 50 * MS,
        "session_start_ns": 0,
    }
    return Channel(link, site=site, **(settings | changes))


def used(sample: PeerSample | None) -> tuple[object, ...] | None:
    """Everything a controller is given, bit for bit."""
    if sample is None:
        return None
    return (
        sample.stamp_ns,
        sample.sequence,
        sample.position_m.tobytes(),
        sample.velocity_m_s.tobytes(),
        sample.force_n.tobytes(),
        sample.state,
        sample.round_trip_ns,
        sample.age_ns,
    )


def knowledge(channel: Channel) -> dict[str, object]:
    """All that a channel tells of its peer, but for what it rejected, and for whose sake."""
    told = {name: getattr(channel, name) for name in _TOLD}
    return told | {"counters": replace(channel.counters, rejected=Counter(), rejected_total=0)}


class Exchange:
    """The peer, the listener that hears hostile datagrams (`shaken`), and the one that does not."""

    def __init__(self, **changes: Any) -> None:
        self._to_shaken, shaken_link = memory_links(CAPACITY)
        self._to_quiet, quiet_link = memory_links(CAPACITY)
        self._to_peer, peer_link = memory_links(CAPACITY)
        self.shaken = listener(shaken_link, **changes)
        self.quiet = listener(quiet_link, **changes)
        self._peer = listener(peer_link, PEER, shared_clock=bool(changes.get("shared_clock")))
        self._ahead_ns = 0 if changes.get("shared_clock") else CLOCKS_APART_NS
        self._tick = 0
        self.now_ns = 0
        self.sample: PeerSample | None = None
        self.heard: list[bytes] = []
        """What the peer has said, oldest first."""
        self.said: list[bytes] = []
        """What the listeners have said."""
        while not (self.quiet.peer_confirmed and self.sample is not None):
            self.tick()

    def tick(self, before: Sequence[bytes] = (), after: Sequence[bytes] = ()) -> None:
        """One tick of all: the peer speaks, then the listeners listen."""
        self.speak()
        self.listen(before, after)

    def speak(self) -> None:
        """Begin a tick: let the peer say its packet, now the last of `heard`."""
        self._move_on()
        angle = 1e-3 * self._tick
        position = np.array([np.cos(angle), np.sin(angle)])
        now_ns = self.now_ns + self._ahead_ns
        self._peer.latest(now_ns)
        self._peer.send(now_ns, 2, position, position[::-1], -position)
        [fresh] = self._to_peer.receive()
        self.heard.append(fresh)

    def listen(self, before: Sequence[bytes] = (), after: Sequence[bytes] = ()) -> None:
        """End the tick; the shaken listener hears hostile datagrams around the peer's packet.

        AssertionError if the two listeners then differ in anything but what they rejected.
        """
        self._listen([*before, self.heard[-1], *after], self.heard[-1:])

    def wait(self, hostile: Sequence[bytes]) -> None:
        """One tick in which the peer says nothing, and the shaken listener hears others only."""
        self._move_on()
        self._listen(hostile, ())

    def _move_on(self) -> None:
        self._tick += 1
        self.now_ns = self._tick * MS

    def _listen(self, shaken: Sequence[bytes], quiet: Sequence[bytes]) -> None:
        for data in shaken:
            assert self._to_shaken.send(data)
        for data in quiet:
            assert self._to_quiet.send(data)
        self.sample = self.quiet.latest(self.now_ns)
        assert used(self.shaken.latest(self.now_ns)) == used(self.sample)
        assert knowledge(self.shaken) == knowledge(self.quiet)
        assert not self.quiet.counters.rejected
        self._listeners_say()

    def receiver(self, newest: bytes) -> Receiver:
        """The listeners, as the reference knows them once they have heard `newest`."""
        return Receiver(SITE, SESSION, DIMENSION, newest)

    def _listeners_say(self) -> None:
        rest = np.zeros(DIMENSION)
        for channel in (self.shaken, self.quiet):
            channel.send(self.now_ns, 2, rest, rest, rest)
        said, expected = self._to_shaken.receive(), self._to_quiet.receive()
        assert said == expected, "what the peer is told of itself"
        for data in said:
            self._to_peer.send(data)
        self.said += said
