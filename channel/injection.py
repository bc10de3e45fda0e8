"""Delay, loss, reordering and duplication, injected into what arrived, on its timestamps.

On the receiving side and in the production path: what a simulation meets is what a site runs.
Seeded: the same packets at the same ticks give the same choices.
"""

import bisect
import heapq
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from channel.delay import BurstLoss, ConstantDelay, Direction
from channel.packet import Packet

DelayMode: TypeAlias = Literal["exact", "added", "off"]

_LOSS, _REORDERING, _DUPLICATION, _DELAY = range(4)
_SLACK_NS = 1_000_000_000  # kept beyond the delay's bound, for an offset estimate that improves
_PRUNE_AT = 256  # packets past use before the list is cut: cutting moves all that stay
_FASTEST_HZ = 4000  # a peer sending faster loses the oldest of its history


class Arrival(NamedTuple):
    """A packet and when it arrived [my clock]."""

    packet: Packet
    arrival_ns: int


class Injection:
    """One direction's network, between arrival and use.

    `exact`: at time t the newest packet stamped at or before t − d(t), the paper's X(t − d(t)),
    network time absorbed; a packet that arrives after a tick it was due at is counted in `late`
    (that tick used the newest there was). `added`: each packet is released at arrival + d(arrival)
    and the newest-stamped one released is used. `off`: the newest there is; the direction is
    ignored, loss included.
    """

    def __init__(
        self,
        direction: Direction | None,
        mode: DelayMode,
        *,
        session_start_ns: int,
        seed: tuple[int, ...],
    ) -> None:
        if mode not in ("exact", "added", "off"):
            raise ValueError(f"mode = {mode!r} is not allowed: it must be exact, added or off")
        if mode != "off" and direction is None:
            raise ValueError(f"mode = {mode!r} needs a direction to inject; without one use 'off'")
        self._mode: DelayMode = mode
        self._start_ns = session_start_ns
        active = direction if mode != "off" else None
        self._delay = active.delay if active else ConstantDelay(0.0)
        self._loss = active.loss if active else None
        self._reordering = active.reordering if active else None
        self._duplication = active.duplication if active else None
        # one stream an effect: switching one off leaves the draws of the others as they were
        self._loss_rng, self._reordering_rng, self._duplication_rng, self._delay_rng = (
            np.random.default_rng((*seed, effect))
            for effect in (_LOSS, _REORDERING, _DUPLICATION, _DELAY)
        )
        bound_s = active.bound_s if active else 0.0
        self._keep_ns = round(bound_s * 1e9) + _SLACK_NS
        self._capacity = _PRUNE_AT + int(_FASTEST_HZ * self._keep_ns * 1e-9)
        self._in_burst = False
        self.late = 0
        self.overtaken = 0
        self.clear()

    def clear(self) -> None:
        """Forget all packets: the peer restarted, and these are on another clock."""
        self._held: list[tuple[int, int, Arrival]] = []  # heap by (release, sequence)
        self._stamps: list[int] = []  # exact: the released, sorted by stamp
        self._arrivals: list[Arrival] = []
        self._newest: Arrival | None = None
        self._newest_target_ns: int | None = None

    def copies(self) -> int:
        """Draw how often the packet now arriving arrives: 0 (lost), 1 or 2 times."""
        if self._loss is not None and self._lost(self._loss):
            return 0
        duplication = self._duplication
        if duplication is not None and self._duplication_rng.random() < duplication.probability:
            return 2
        return 1

    def _lost(self, loss: BurstLoss) -> bool:
        rng = self._loss_rng
        if self._in_burst:
            self._in_burst = rng.random() >= loss.leave_burst
        else:
            self._in_burst = rng.random() < loss.enter_burst
        return rng.random() < (loss.loss_in_burst if self._in_burst else loss.loss_outside)

    def put(self, packet: Packet, arrival_ns: int) -> None:
        """Take a packet that arrived [my clock]."""
        release_ns = arrival_ns
        if self._mode == "added":
            release_ns += self._delay_ns(arrival_ns)
        reordering = self._reordering
        if reordering is not None and self._reordering_rng.random() < reordering.probability:
            release_ns += round(reordering.extra_s * 1e9)
        if release_ns <= arrival_ns and not self._held:  # what is held may be due before it
            self._release(Arrival(packet, arrival_ns))
        else:
            arrival = Arrival(packet, arrival_ns)
            heapq.heappush(self._held, (release_ns, packet.sequence, arrival))
            if len(self._held) > self._capacity:  # too early rather than without end
                self._release(heapq.heappop(self._held)[2])

    def choose(self, now_ns: int, offset_ns: int) -> Arrival | None:
        """Return the packet to use at `now_ns`; None if none is due yet.

        A stamp of the peer's plus `offset_ns` is on my clock.
        """
        held = self._held
        while held and held[0][0] <= now_ns:
            self._release(heapq.heappop(held)[2])
        if self._mode != "exact":
            return self._newest
        stamps = self._stamps
        target_ns = now_ns - self._delay_ns(now_ns) - offset_ns
        if self._newest_target_ns is None or target_ns > self._newest_target_ns:
            self._newest_target_ns = target_ns
        chosen = bisect.bisect_right(stamps, target_ns) - 1
        arrival = self._arrivals[chosen] if chosen >= 0 else None
        self._prune(now_ns - self._keep_ns - offset_ns)
        return arrival

    def _delay_ns(self, time_ns: int) -> int:
        time_s = (time_ns - self._start_ns) * 1e-9
        return round(self._delay.at(time_s, self._delay_rng) * 1e9)

    def _release(self, arrival: Arrival) -> None:
        stamp_ns = arrival.packet.stamp_ns
        overtaken = self._newest is not None and stamp_ns < self._newest.packet.stamp_ns
        if overtaken:
            self.overtaken += 1
        else:
            self._newest = arrival
        if self._mode != "exact":
            return
        # at an earlier tick this packet was already due
        if self._newest_target_ns is not None and stamp_ns <= self._newest_target_ns:
            self.late += 1
        place = bisect.bisect_right(self._stamps, stamp_ns)
        self._stamps.insert(place, stamp_ns)
        self._arrivals.insert(place, arrival)

    def _prune(self, horizon_ns: int) -> None:
        stamps = self._stamps
        if len(stamps) <= _PRUNE_AT:
            return
        # the newest at the horizon stays: it is in use if the peer has been silent since
        past = bisect.bisect_right(stamps, horizon_ns) - 1
        excess = max(past, len(stamps) - self._capacity)
        if excess >= _PRUNE_AT:
            del stamps[:excess]
            del self._arrivals[:excess]
