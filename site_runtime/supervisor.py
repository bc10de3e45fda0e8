"""When a site may drive its robot: states, transitions, and the point it is driven to.

| from | to | when |
|---|---|---|
| READY | ENGAGED | peer heard, same session, two-way exchange proven, start time reached |
| ENGAGED | HOLD | peer silent for `hold_after`, offline, in fault, or started anew |
| ENGAGED | HOLD | this site itself stalled for `hold_after` |
| HOLD | ENGAGED | peer back, two-way exchange proven again |
| any | FAULT | any exception; latched: only a new start leaves it |
| any | OFFLINE | clean stop |

Torque flows in ENGAGED and HOLD only.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt

from channel.channel import Counters, PeerSample
from control_law.ramp import smooth_ramp

FloatArray = npt.NDArray[np.float64]


class State(IntEnum):
    """What a site is doing; travels in every packet."""

    OFFLINE = 0
    READY = 1
    ENGAGED = 2
    HOLD = 3
    FAULT = 4


DRIVEN = frozenset({State.ENGAGED, State.HOLD})
_PEER_FIT = frozenset({State.READY, State.ENGAGED, State.HOLD})


class PeerPresence(Protocol):
    """What the supervisor asks of the channel; undelayed, so that silence is seen at once."""

    @property
    def heard_ns(self) -> int | None:
        """Arrival of the newest valid packet [ns], None before the first."""
        ...

    @property
    def heard_state(self) -> int | None:
        """State in that packet."""
        ...

    @property
    def peer_confirmed(self) -> bool:
        """That packet answers one of this very process: a live exchange, not a recording."""
        ...

    @property
    def counters(self) -> Counters:
        """Among them, how often another run of the peer took the place of the one heard before."""
        ...


@dataclass(frozen=True, slots=True)
class EngagementTimes:
    """When and how fast to engage. `not_before_ns` is on the site's clock."""

    not_before_ns: int
    hold_after_ns: int
    blend_s: float


class Supervisor:
    """The state of one site and the peer's point that its controller is given."""

    def __init__(self, times: EngagementTimes) -> None:
        self._times = times
        self._engaged_ns = 0
        self._updated_ns: int | None = None
        self._resumed_ns: int | None = None
        self._held: FloatArray | None = None
        self._peer_restarts = 0
        self.state = State.READY
        self.target_m: FloatArray | None = None

    def update(self, now_ns: int, presence: PeerPresence, peer: PeerSample | None) -> State:
        """Take one tick's look at the peer; return the state that this tick runs in."""
        peer_fit = self._peer_fit(now_ns, presence)
        # after a stall of this site itself the peer's point is elsewhere: hold, then blend
        stalled = (
            self._updated_ns is not None and now_ns - self._updated_ns > self._times.hold_after_ns
        )
        self._updated_ns = now_ns
        same_peer = presence.counters.peer_restarts == self._peer_restarts
        self._peer_restarts = presence.counters.peer_restarts
        if self.state is State.READY:
            if peer_fit and peer is not None and now_ns >= self._times.not_before_ns:
                self.state = State.ENGAGED
                self._engaged_ns = now_ns
        elif self.state is State.ENGAGED:
            if stalled or not (peer_fit and same_peer):
                self.state = State.HOLD
                self._held = self.target_m
        elif self.state is State.HOLD and peer_fit and peer is not None:
            self.state = State.ENGAGED
            self._resumed_ns = now_ns
        if self.state is State.ENGAGED and peer is not None:
            self.target_m = self._blended(now_ns, peer.position_m)
        return self.state

    def engaged_s(self, now_ns: int) -> float:
        """Time since engagement [s]; the controllers' ramps run on it, through HOLD too."""
        return (now_ns - self._engaged_ns) * 1e-9

    def fault(self) -> None:
        """Latch FAULT."""
        self.state = State.FAULT

    def stop(self) -> None:
        """Go OFFLINE for a clean end; a fault stays a fault."""
        if self.state is not State.FAULT:
            self.state = State.OFFLINE

    def _peer_fit(self, now_ns: int, presence: PeerPresence) -> bool:
        heard_ns = presence.heard_ns
        return (
            heard_ns is not None
            and now_ns - heard_ns <= self._times.hold_after_ns
            and presence.peer_confirmed
            and presence.heard_state in _PEER_FIT
        )

    def _blended(self, now_ns: int, position_m: FloatArray) -> FloatArray:
        """After HOLD, move from the held point to the peer's, so that the force does not jump."""
        if self._resumed_ns is None or self._held is None:
            return position_m
        share, _ = smooth_ramp((now_ns - self._resumed_ns) * 1e-9, self._times.blend_s)
        if share >= 1.0:
            self._resumed_ns = None
            return position_m
        return self._held + share * (position_m - self._held)
