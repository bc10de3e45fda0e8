"""What the network between the sites does to their packets: two sites' channels without robots."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from channel.channel import Channel
from channel.link import Link, LinkError, TappedLink
from channel.packet import Packet, PacketError, Reject, decode
from site_runtime.clock import Clock, Pacer
from site_runtime.keys import SiteId
from site_runtime.other_session import OtherSession
from site_runtime.security.network import most_relayed_hz
from site_runtime.session import Session

RATE_DIVISORS: Final = (1, 2, 4, 10)
"""The rates tried, as parts of the loop's."""

SETTLE_S: Final = 1.5
"""Not counted at the start of each rate: queues drain, and the greatest age looks back a second."""

PATIENCE_S: Final = 10.0
"""So long it waits for the first answer."""

_IDLE_HZ = 100  # of an end that nobody has told a rate
_SILENCE_NS = 1_000_000_000
_OTHER_DIGEST = 0x6C696E6B_74657374  # a site takes no test packet for its peer's, nor the reverse
_STATE = 0
_REPORT = 6


class LinkTestError(LinkError):
    """The test cannot be made; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class Report:
    """What an end tells of itself in the vectors of each packet: the rate it wants, its counts."""

    rate_hz: float
    sent: float
    received: float
    lost: float
    out_of_order: float
    duplicates: float

    @classmethod
    def of(cls, packet: Packet) -> "Report":
        """Read it out of a packet."""
        vectors = np.concatenate((packet.position_m, packet.velocity_m_s, packet.force_n))
        return cls(*vectors[:_REPORT].tolist())


@dataclass(frozen=True, slots=True)
class Ticks:
    """What was seen at the ticks [ns], -1 where nothing: age of the loop, and the bound on it.

    The bound is what a site compares with the certified round trip.
    """

    loop_ns: list[int]
    bound_ns: list[int]


@dataclass(frozen=True, slots=True)
class Phase:
    """One rate: the packets that arrived within (first, last) [ns], with when, and the ticks.

    `before` are packets since the connection: for the clocks.
    """

    rate_hz: int
    first_ns: int
    last_ns: int
    arrived: list[tuple[int, Packet]]
    before: list[tuple[int, Packet]]
    ticks: Ticks


class Probe:
    """One end of a test: sends as a site does, and takes in as a site does, on its very keys."""

    def __init__(self, session: Session, site: SiteId, link: Link, clock: Clock) -> None:
        self._digest = session.digest
        self._clock = clock
        self._site = site
        self._loop_hz = session.loop.rate_hz
        self._period_ns = session.period_ns
        self._dimension = session.task.dimension
        self._epoch = time.time_ns()
        self.heard: list[tuple[int, bytes]] = []
        self._channel = Channel(
            TappedLink(link, self._tap),
            site=site,
            session_digest=session.digest ^ _OTHER_DIGEST,
            epoch=self._epoch,
            dimension=self._dimension,
            send_period_ns=0,  # this class chooses the ticks
            silence_ns=_SILENCE_NS,
            session_start_ns=clock.now_ns(),
        )
        self._other = OtherSession(session, self._other_digest)

    def answer(self, should_stop: Callable[[], bool]) -> None:
        """Send at the rate that the other end wants, until told to stop.

        Raises LinkTestError if a site of the session is heard.
        """
        pacer, tick = Pacer(self._clock, self._period_ns), 0
        while not should_stop():
            pacer.wait()
            now_ns, tick = self._clock.now_ns(), tick + 1
            sample = self._channel.latest(now_ns)
            wanted_hz = 0.0
            if sample is not None and now_ns - sample.arrival_ns < _SILENCE_NS:
                flat = np.concatenate((sample.position_m, sample.velocity_m_s, sample.force_n))
                wanted_hz = float(flat[0])
            if tick % self._every(wanted_hz or _IDLE_HZ) == 0:
                self._send(now_ns, wanted_hz)
            for _, data in self.heard:
                self._packet(data)
            self.heard.clear()

    def meet(self, should_stop: Callable[[], bool]) -> bool:
        """Wait for the other end; False if told to stop. LinkTestError if it does not come."""
        pacer, tick = Pacer(self._clock, self._period_ns), 0
        end_ns = self._clock.now_ns() + round(PATIENCE_S * 1e9)
        while not should_stop():
            pacer.wait()
            now_ns, tick = self._clock.now_ns(), tick + 1
            self._channel.latest(now_ns)
            if tick % self._every(_IDLE_HZ) == 0:
                self._send(now_ns, _IDLE_HZ)
            for _, data in self.heard:
                self._packet(data)
            if self._other.trouble is not None:
                raise LinkTestError(f"{self._other.trouble}: copy one file to the other end")
            if self._channel.loop_bound_ns is not None:
                return True
            if now_ns >= end_ns:
                raise LinkTestError(
                    f"nobody answered for {PATIENCE_S:g} s: run `farhand link-test SESSION "
                    f"--answer` on the {self._site.peer.label} site's machine"
                )
        return False

    def measure(
        self, rate_hz: int, duration_s: float, should_stop: Callable[[], bool]
    ) -> Phase | None:
        """Send at a rate for so long, the settling not counted; None if told to stop."""
        ticks = Ticks([], [])
        start_ns = self._clock.now_ns()
        first_ns = start_ns + round(SETTLE_S * 1e9)
        last_ns = first_ns + round(duration_s * 1e9)
        pacer, tick, every = Pacer(self._clock, self._period_ns), 0, self._every(rate_hz)
        while (now_ns := self._clock.now_ns()) < last_ns:
            if should_stop():
                return None
            sample = self._channel.latest(now_ns)
            if now_ns >= first_ns:
                trip_ns = None if sample is None else sample.round_trip_ns
                bound_ns = self._channel.loop_bound_ns
                ticks.loop_ns.append(-1 if trip_ns is None else trip_ns)
                ticks.bound_ns.append(-1 if bound_ns is None else bound_ns + 2 * self._period_ns)
            if tick % every == 0:
                self._send(now_ns, rate_hz)
            pacer.wait()
            tick += 1
        arrived: list[tuple[int, Packet]] = []
        before: list[tuple[int, Packet]] = []
        for arrival_ns, data in self.heard:
            packet = self._packet(data)
            if packet is not None and packet.echo_epoch == self._epoch:
                (arrived if arrival_ns >= first_ns else before).append((arrival_ns, packet))
        self.heard.clear()
        if len(arrived) < 2:
            raise LinkTestError(f"the other end fell silent at {rate_hz} Hz")
        return Phase(rate_hz, first_ns, last_ns, arrived, before, ticks)

    def _every(self, rate_hz: float) -> int:
        return max(1, round(self._loop_hz / rate_hz))

    def _other_digest(self) -> int | None:
        digest = self._channel.other_session
        return None if digest is None else digest ^ _OTHER_DIGEST

    def _tap(self, arrived: list[bytes]) -> None:
        now_ns = self._clock.now_ns()
        self.heard += [(now_ns, data) for data in arrived]

    def _send(self, now_ns: int, rate_hz: float) -> None:
        counters, z = self._channel.counters, self._dimension
        flat = np.zeros(3 * z)
        flat[:_REPORT] = (
            rate_hz,
            counters.sent,
            counters.received,
            counters.lost,
            counters.rejected[Reject.OUT_OF_ORDER],
            counters.rejected[Reject.DUPLICATE],
        )
        self._channel.send(now_ns, _STATE, flat[:z], flat[z : 2 * z], flat[2 * z :])

    def _packet(self, data: bytes) -> Packet | None:
        """Return a test packet of the other end; LinkTestError if it is a site's."""
        try:
            packet = decode(data)
        except PacketError:
            return None
        if packet.session == self._digest:
            raise LinkTestError(
                f"the {self._site.peer.label} site of this session is running: stop it first, "
                "a test's packets would compete with its own"
            )
        return packet if packet.session == self._digest ^ _OTHER_DIGEST else None


def rates_of(session: Session) -> tuple[int, ...]:
    """Return the rates to try [Hz], fastest first, the session's own among them."""
    loop_hz, most_hz = session.loop.rate_hz, most_measured_hz(session)
    own_hz = round(1e9 / session.send_period_ns)
    tried = {rate for k in RATE_DIVISORS if (rate := loop_hz // k) <= most_hz}
    return tuple(sorted(tried | {own_hz}, reverse=True))


def most_measured_hz(session: Session) -> float:
    """Return the fastest rate that reaches the other end whole.

    A relay thins packets that come closer together than at its rate, and half a period early must
    be no loss.
    """
    relayed_hz = most_relayed_hz(session)
    return session.loop.rate_hz if relayed_hz is None else relayed_hz / 2
