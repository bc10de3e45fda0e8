"""One site's end of the channel: what it knows of its peer, and what it tells it."""

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from channel.clock_offset import ClockOffset, OffsetEstimate
from channel.delay import Direction
from channel.greatest_age import GreatestAge
from channel.injection import DelayMode, Injection
from channel.link import Link
from channel.packet import NO_AGE, NO_EPOCH, NO_STAMP, Packet, PacketError, Reject, decode, encode
from channel.send_rate import SendRate

FloatArray = npt.NDArray[np.float64]

_MISMATCH_SHOWN_NS = 1_000_000_000  # for people: long enough to be read, short enough to clear


class PeerSample(NamedTuple):
    """The peer's sample in use at a tick; vectors (z,) in base axes, read-only.

    `stamp_ns` is on the peer's clock, `arrival_ns`, when it came, on mine. `age_ns` is how old the
    sample is, by the clock offset estimate. `round_trip_ns` is the age of the whole loop on my
    clock alone: now minus my own stamp that the peer was using when it sent this; injected delay,
    network, packet spacing and hold are all in it. It is None while the peer was using no sample of
    mine.
    """

    stamp_ns: int
    arrival_ns: int
    sequence: int
    position_m: FloatArray
    velocity_m_s: FloatArray
    force_n: FloatArray
    state: int
    round_trip_ns: int | None
    age_ns: int


@dataclass(slots=True)
class Counters:
    """What passed and what did not, since the start."""

    sent: int = 0
    send_dropped: int = 0
    received: int = 0
    """Valid packets, in order."""
    lost: int = 0
    """Sequence numbers skipped: lost on the way, by injection, or overtaken (then rejected too)."""
    lost_injected: int = 0
    late: int = 0
    """Packets that arrived after their exact injected delay had passed."""
    overtaken: int = 0
    """Packets that injection released after a newer one."""
    peer_restarts: int = 0
    rejected: Counter[Reject] = field(default_factory=Counter)
    rejected_total: int = 0

    def reject(self, reason: Reject) -> None:
        """Count one that was refused."""
        self.rejected[reason] += 1
        self.rejected_total += 1


class Channel:
    """Validate, delay, choose; stamp, echo, send. One thread, one call of each a tick."""

    def __init__(
        self,
        link: Link,
        *,
        site: int,
        session_digest: int,
        epoch: int,
        dimension: int,
        send_period_ns: int,
        silence_ns: int,
        session_start_ns: int,
        direction: Direction | None = None,
        mode: DelayMode = "off",
        seed: int = 0,
        shared_clock: bool = False,
        slowest_send_period_ns: int | None = None,
    ) -> None:
        """Join `link`. `site` is mine, 0 or 1; `direction` and `mode` delay what comes to me.

        `epoch` names this run of the process and must differ from every earlier one. A silence of
        `silence_ns` is what it takes to accept a restarted peer. Session time, which the delay
        models run on, is zero at `session_start_ns` (my clock, may lie ahead). `shared_clock` says
        that both sites stamp on one clock: the offset is then zero, not estimated. The send period
        grows up to `slowest_send_period_ns` while packets pile up on their way; None: never.
        """
        _require_range("site", site, 0, 1)
        _require_range("session_digest", session_digest, 0, 2**64 - 1)
        _require_range("epoch", epoch, NO_EPOCH + 1, 2**64 - 1)
        _require_range("dimension", dimension, 2, 3)
        _require_range("send_period_ns", send_period_ns, 0, 2**63 - 1)
        _require_range("silence_ns", silence_ns, 1, 2**63 - 1)
        self._link = link
        self._site = site
        self._session = session_digest
        self._epoch = epoch
        self._dimension = dimension
        self._rate = SendRate(
            send_period_ns,
            send_period_ns if slowest_send_period_ns is None else slowest_send_period_ns,
        )
        self._silence_ns = silence_ns
        self._clock_offset = ClockOffset()
        self._shared_clock = shared_clock
        # the receiving site names the direction: each has its own draws from the one seed
        self._injection = Injection(
            direction, mode, session_start_ns=session_start_ns, seed=(seed, site)
        )
        self.counters = Counters()
        self.longest_way_ns: int | None = None
        """Of the packets that the last `latest` took in: from stamp to arrival, on two clocks."""
        self._now_ns: int | None = None
        self._newest: Packet | None = None
        self._heard_ns = 0
        self._mismatch_ns: int | None = None
        self._other_session = session_digest
        self._replaced: set[int] = set()
        self._used_stamp_ns = NO_STAMP
        self._greatest_age = GreatestAge()
        self._sequence = 0
        self._due_ns: int | None = None
        self._asked_ns = 0
        self._vectors: FloatArray = np.zeros((3, dimension))

    def latest(self, now_ns: int) -> PeerSample | None:
        """Take in all that arrived and return the sample to use at `now_ns` [my clock].

        None until a sample is due, and until the peer has answered a packet of mine (the clock
        offset comes from that). While the peer is silent the last sample stays, and ages. Real-time
        safe, never raises.
        """
        self._now_ns = now_ns
        self.longest_way_ns = None
        for data in self._link.receive():
            self._arrive(data, now_ns)
        offset_ns = 0 if self._shared_clock else self._clock_offset.offset_ns
        if offset_ns is None:
            return None
        chosen = self._injection.choose(now_ns, offset_ns)
        self.counters.late = self._injection.late
        self.counters.overtaken = self._injection.overtaken
        if chosen is None:
            self._used_stamp_ns = NO_STAMP
            return None
        packet = chosen.packet
        self._used_stamp_ns = packet.stamp_ns
        self._greatest_age.add(now_ns, now_ns - packet.stamp_ns)
        answered = packet.echo_epoch == self._epoch and packet.used_stamp_ns != NO_STAMP
        return PeerSample(
            packet.stamp_ns,
            chosen.arrival_ns,
            packet.sequence,
            packet.position_m,
            packet.velocity_m_s,
            packet.force_n,
            packet.state,
            now_ns - packet.used_stamp_ns if answered else None,
            now_ns - packet.stamp_ns - offset_ns,
        )

    def send(
        self,
        now_ns: int,
        state: int,
        position_m: FloatArray,
        velocity_m_s: FloatArray,
        force_n: FloatArray,
    ) -> bool:
        """Send my sample, vectors (z,), if one is due; return whether a packet left.

        Call it every tick: it sends at the tick nearest to each multiple of the send period. Real-
        time safe; ValueError if a vector is not (z,).
        """
        if not self._due(now_ns):
            return False
        vectors = self._vectors
        vectors[0] = position_m
        vectors[1] = velocity_m_s
        vectors[2] = force_n
        newest = self._newest
        self._sequence += 1
        data = encode(
            site=self._site,
            state=state,
            session=self._session,
            epoch=self._epoch,
            sequence=self._sequence,
            stamp_ns=now_ns,
            echo_epoch=newest.epoch if newest is not None else NO_EPOCH,
            echo_stamp_ns=newest.stamp_ns if newest is not None else NO_STAMP,
            echo_arrival_ns=self._heard_ns,
            used_stamp_ns=self._used_stamp_ns,
            greatest_age_ns=self._greatest_age.value_ns,
            vectors=vectors,
        )
        if not self._link.send(data):
            self.counters.send_dropped += 1
            return False
        self.counters.sent += 1
        return True

    def welcome_back(self) -> None:
        """Let runs of the peer that another has replaced come back. Real-time safe.

        For where more than their epoch tells a live run from a recording: certificates, a lease.
        """
        self._replaced.clear()

    @property
    def send_period_ns(self) -> int:
        """Time between two packets at present [ns]."""
        return self._rate.period_ns

    @property
    def slowed(self) -> bool:
        """Whether it sends less often than it may, as packets piled up."""
        return self._rate.share < 1.0

    @property
    def heard_ns(self) -> int | None:
        """When the newest valid packet arrived [my clock]; None before the first."""
        return self._heard_ns if self._newest is not None else None

    @property
    def heard_state(self) -> int | None:
        """The peer's state in the newest valid packet, not delayed; None before the first."""
        return self._newest.state if self._newest is not None else None

    @property
    def peer_confirmed(self) -> bool:
        """Whether the newest valid packet answers this very run of mine: no recording can."""
        return self._newest is not None and self._newest.echo_epoch == self._epoch

    @property
    def echoed_ns(self) -> int | None:
        """Stamp of my newest sample that the peer has heard; None if it tells of none."""
        return self._newest.echo_stamp_ns if self._newest and self.peer_confirmed else None

    @property
    def peer_taken(self) -> bool:
        """Whether the newest valid packet answers another site than this one: one is enough."""
        return self._newest is not None and self._newest.echo_epoch not in (NO_EPOCH, self._epoch)

    @property
    def loop_bound_ns(self) -> int | None:
        """Greatest age of the samples in use of late, mine plus the peer's [ns]; None: not yet.

        At ticks, so that each site's holds one tick more. Clocks need not agree: their difference
        enters the two with opposite signs.
        """
        mine_ns = self._greatest_age.value_ns
        if mine_ns == NO_AGE or self._newest is None or not self.peer_confirmed:
            return None
        theirs_ns = self._newest.greatest_age_ns
        return None if theirs_ns == NO_AGE else max(0, mine_ns + theirs_ns)

    @property
    def peer_present(self) -> bool:
        """Whether the link sees the peer's process. For people: silence is what safety watches."""
        return self._link.peer_present()

    @property
    def other_session(self) -> int | None:
        """Digest of a peer's session file that is not mine, if heard within the last second."""
        if self._mismatch_ns is None or self._now_ns is None:
            return None
        shown = self._now_ns - self._mismatch_ns < _MISMATCH_SHOWN_NS
        return self._other_session if shown else None

    @property
    def offset(self) -> OffsetEstimate | None:
        """The clock offset, from the peer's to mine; None before the first exchange."""
        if self._shared_clock:
            return OffsetEstimate(0, 0)
        return None if self._now_ns is None else self._clock_offset.estimate(self._now_ns)

    @property
    def one_way_ns(self) -> int | None:
        """Network time of the newest valid packet to me [ns], ± the offset's uncertainty."""
        offset_ns = 0 if self._shared_clock else self._clock_offset.offset_ns
        if self._newest is None or offset_ns is None:
            return None
        return self._heard_ns - self._newest.stamp_ns - offset_ns

    def _arrive(self, data: bytes, now_ns: int) -> None:
        try:
            packet = decode(data)
        except PacketError as error:
            self.counters.reject(error.reason)
            return
        reason = self._foreign(packet, now_ns)
        if reason is not None:
            self.counters.reject(reason)
            return
        copies = self._injection.copies()
        if copies == 0:
            self.counters.lost_injected += 1
            return
        for _ in range(copies):
            self._accept(packet, now_ns)

    def _foreign(self, packet: Packet, now_ns: int) -> Reject | None:
        """Return why this is not from my peer in its present run; None if it is."""
        if packet.site != 1 - self._site:
            return Reject.SITE
        if packet.session != self._session:
            self._mismatch_ns = now_ns
            self._other_session = packet.session
            return Reject.SESSION
        if packet.position_m.size != self._dimension:
            return Reject.DIMENSION
        newest = self._newest
        if packet.epoch in self._replaced:
            return Reject.EPOCH
        if newest is not None and packet.epoch != newest.epoch:
            silent = now_ns - self._heard_ns >= self._silence_ns
            # a recording may have been heard first: it gives way to a peer that answers me
            answers = packet.echo_epoch == self._epoch and newest.echo_epoch != self._epoch
            if not silent and not answers:
                return Reject.EPOCH
        return None

    def _accept(self, packet: Packet, now_ns: int) -> None:
        newest = self._newest
        if newest is not None and packet.epoch != newest.epoch:
            if packet.echo_epoch == self._epoch:
                # a live run has taken its place: what is heard of it from now on is a recording
                self._replaced.add(newest.epoch)
            self._forget_peer()
            newest = None
        if newest is not None:
            gap = packet.sequence - newest.sequence
            reason = None
            if gap == 0:
                reason = Reject.DUPLICATE
            elif gap < 0:
                reason = Reject.OUT_OF_ORDER
            elif packet.stamp_ns <= newest.stamp_ns:
                reason = Reject.STAMP
            if reason is not None:
                self.counters.reject(reason)
                return
            self.counters.lost += gap - 1
        self.counters.received += 1
        way_ns = now_ns - packet.stamp_ns
        if self.longest_way_ns is None or way_ns > self.longest_way_ns:
            self.longest_way_ns = way_ns
        self._newest = packet
        self._heard_ns = now_ns
        if packet.echo_epoch == self._epoch:
            self._rate.heard(now_ns, packet.echo_stamp_ns, packet.echo_arrival_ns)
            if not self._shared_clock:
                self._clock_offset.update(
                    packet.echo_stamp_ns, packet.echo_arrival_ns, packet.stamp_ns, now_ns
                )
        self._injection.put(packet, now_ns)

    def _forget_peer(self) -> None:
        self.counters.peer_restarts += 1
        self._injection.clear()
        self._clock_offset.reset()
        self._greatest_age.reset()
        self._rate.reset()
        self._used_stamp_ns = NO_STAMP

    def _due(self, now_ns: int) -> bool:
        if self._due_ns is None:
            self._due_ns = now_ns
            self._asked_ns = now_ns
        half_tick_ns = (now_ns - self._asked_ns) // 2
        self._asked_ns = now_ns
        if now_ns + half_tick_ns < self._due_ns:
            return False
        self._due_ns += self._rate.period_ns
        if self._due_ns <= now_ns:  # after a stall: no burst to catch up
            self._due_ns = now_ns + self._rate.period_ns
        return True


def _require_range(key: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{key} = {value} is not allowed: it must be between {low} and {high}")
