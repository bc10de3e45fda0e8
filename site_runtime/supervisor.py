"""When a site may drive its robot: states, transitions, and the point it is driven to.

| from | to | when |
|---|---|---|
| READY, ALIGNING | ENGAGED | peer agrees, start time reached, points within `align_within_m` |
| READY | ALIGNING | the same, but the points are further apart |
| ALIGNING | READY | peer no longer agrees |
| ENGAGED | HOLD | peer silent for `hold_after`, offline, stopped, or started anew |
| ENGAGED | HOLD | the outputs of a peer that drove go off |
| ENGAGED | HOLD | this site stalled for `hold_after`, or its ticks come late one after the other |
| ENGAGED | HOLD | the loop is older than what `derate_to` of the gains is proven for |
| HOLD | ENGAGED | all of that is over; a peer that engaged anew meanwhile drives, and is aligned |
| HOLD | READY | after `stop_after`; in its last `release` nothing leads back |
| ENGAGED | HOLD | the lease is over: the last `release` of a HOLD begins, as it does of any other |
| RELEASED | READY | the lease is over, and `release` too |
| ENGAGED, HOLD | RELEASED | the local operator opens the clutch |
| RELEASED | ENGAGED, HOLD | the clutch is closed again; HOLD where HOLD would not end |
| any but FAULT | EMERGENCY_STOP | its operator says so; in all but READY, the peer is in it |
| any | FAULT | any exception |
| FAULT, EMERGENCY_STOP | READY | reset by this site's operator |
| any but FAULT, EMERGENCY_STOP | OFFLINE | clean stop |

The peer agrees when it is heard, by the same session, in a live two-way exchange, and is itself in
READY, ALIGNING, ENGAGED, HOLD or RELEASED. Torque flows in ENGAGED, HOLD and RELEASED only.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum
from math import dist
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
    ALIGNING = 2
    ENGAGED = 3
    HOLD = 4
    RELEASED = 5
    FAULT = 6
    EMERGENCY_STOP = 7


DRIVEN = frozenset({State.ENGAGED, State.HOLD, State.RELEASED})
STOPPED = frozenset({State.FAULT, State.EMERGENCY_STOP})
"""Latched: only a reset by this site's operator leaves them."""

_OUTPUTS_OFF = frozenset({State.READY, State.ALIGNING})
_PEER_FIT = _OUTPUTS_OFF | DRIVEN


class Cause(Enum):
    """Why a site is in its state."""

    NO_PEER = "no live peer yet"
    NOT_YET = "the session has not started yet"
    UNLEASED = "nobody here holds the lease"
    AGREED = "both sites agree"
    APART = "the robots' points are too far apart"
    SILENT = "the peer is silent"
    PEER_UNFIT = "the peer is offline or stopped"
    PEER_ANEW = "the peer was started anew"
    PEER_OFF = "the peer's outputs are off"
    STALLED = "this site stalled"
    LATE = "the ticks of this site come late, one after the other"
    MARGIN = "the loop is older than the gains are proven for"
    LONG_HOLD = "held for too long"
    CLUTCH = "the clutch is open"
    OPERATOR = "the operator of this site stopped it"
    PEER_STOP = "the peer is in emergency stop"
    FAILURE = "this site failed"
    RESET = "reset by the operator of this site"
    ENDED = "this site ends"


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
class EngagementRules:
    """When and how a site engages. `not_before_ns` is on the site's clock.

    `leads` is true for the operator's site, which may open the clutch; `clutched` if it takes the
    robots' points, as far apart as they are, for one and the same.
    """

    not_before_ns: int
    hold_after_ns: int
    stop_after_ns: int
    ramp_s: float
    release_s: float
    blend_s: float
    align_within_m: float
    derate_to: float
    leads: bool
    clutched: bool


class Supervisor:
    """The state of one site, why, and the point and the share of force its controller is given.

    A site's own point X and what it tells its peer differ by `offset_m` (z,), which only the clutch
    moves: told = X − offset, target = peer's point + offset.
    """

    def __init__(self, rules: EngagementRules, dimension: int) -> None:
        self._rules = rules
        self._engaged_ns = 0
        self._coupled_ns = 0
        self._held_ns = 0
        self._released_ns = 0
        self._released_share = 0.0
        self._updated_ns: int | None = None
        self._resumed_ns: int | None = None
        self._held: FloatArray | None = None
        self._told_m = np.zeros(dimension)
        self._peer_restarts = 0
        self._peer_anew = False
        self._peer_drove = False
        self._scale = self._proven = 1.0
        self.state = State.READY
        self.cause = Cause.NO_PEER
        self.target_m: FloatArray | None = None
        self.offset_m: FloatArray = np.zeros(dimension)
        self.apart_m = 0.0

    def update(
        self,
        now_ns: int,
        presence: PeerPresence,
        peer: PeerSample | None,
        own_m: FloatArray,
        *,
        scale: float = 1.0,
        late: bool = False,
        clutch: bool = False,
        emergency_stop: bool = False,
        unleased: bool = False,
    ) -> State:
        """Take one tick's look at peer, operator and loop; return the state this tick runs in.

        `own_m` is X (z,); `scale` the share of the gains that is proven at the loop's present age;
        `late` that too many ticks in a row were; `clutch` that the operator holds it open;
        `unleased` that the operator has no right to the remote robot.
        """
        self._proven = scale
        trouble = self._trouble(now_ns, presence, peer, late)
        clutch = clutch and self._rules.leads
        if self.state in STOPPED or self.state is State.OFFLINE:
            return self.state
        if emergency_stop:
            self._go(State.EMERGENCY_STOP, Cause.OPERATOR)
        elif self._peer_says_stop(presence):
            self._go(State.EMERGENCY_STOP, Cause.PEER_STOP)
        elif unleased:
            self._let_go(now_ns, own_m)
        elif self.state in _OUTPUTS_OFF:
            self._wait(now_ns, presence, peer, own_m, trouble)
        elif clutch and self.state is not State.RELEASED:
            self._release(now_ns, own_m)
        elif self.state is State.ENGAGED and trouble is not None:
            self._hold(now_ns, self.target_m, trouble)
        elif self.state is State.HOLD:
            self._try_to_resume(now_ns, presence, peer, own_m, trouble)
        elif self.state is State.RELEASED:
            self._follow_the_hand(now_ns, presence, peer, own_m, clutch, trouble)
        self._move_scale(now_ns)
        self._updated_ns = now_ns
        if self.state is State.ENGAGED and peer is not None:
            self.target_m = self._blended(now_ns, peer.position_m + self.offset_m)
        return self.state

    @property
    def scale(self) -> float:
        """Share of the gains left by de-rating, 1 if none is taken."""
        return self._scale

    def told_m(self, own_m: FloatArray) -> FloatArray:
        """Return the point (z,) to tell the peer, for this site's X."""
        return self._told_m if self.state is State.RELEASED else own_m - self.offset_m

    def engaged_s(self, now_ns: int) -> float:
        """Time since engagement [s]; the sub-task's ramp runs on it, through HOLD too."""
        return (now_ns - self._engaged_ns) * 1e-9

    def force_share(self, now_ns: int) -> float:
        """Share of stiffness and force ceiling in force, 0 to 1; never jumps while driven.

        It grows over `ramp_s`, and falls within `release_s`: when de-rated, when the clutch opens,
        and before a HOLD that has lasted too long ends.
        """
        rules = self._rules
        if self.state is State.RELEASED:
            return self._released_share * (1.0 - self._gone(now_ns - self._released_ns))
        share, _ = smooth_ramp((now_ns - self._coupled_ns) * 1e-9, rules.ramp_s)
        share *= self._scale
        if self.state is State.HOLD:
            return share * (1.0 - self._gone(round(rules.release_s * 1e9) - self._left_ns(now_ns)))
        return share

    def fault(self) -> None:
        """Latch FAULT."""
        self._go(State.FAULT, Cause.FAILURE)

    def reset(self) -> None:
        """Leave FAULT or EMERGENCY_STOP for READY; of what was, only the offset stays."""
        if self.state in STOPPED:
            self._go(State.READY, Cause.RESET)
            self.target_m = self._held = self._resumed_ns = None

    def stop(self) -> None:
        """Go OFFLINE for a clean end; what is latched stays."""
        if self.state not in STOPPED:
            self._go(State.OFFLINE, Cause.ENDED)

    def _go(self, state: State, cause: Cause) -> None:
        self.state = state
        self.cause = cause

    def _trouble(
        self,
        now_ns: int,
        presence: PeerPresence,
        peer: PeerSample | None,
        late: bool,
    ) -> Cause | None:
        """Return what forbids to be ENGAGED now; None if nothing does."""
        rules, restarts, heard = self._rules, presence.counters.peer_restarts, presence.heard_state
        anew = restarts != self._peer_restarts
        self._peer_restarts = restarts
        off = self._peer_drove and heard in _OUTPUTS_OFF
        self._peer_drove = heard in DRIVEN
        self._peer_anew = self._peer_anew or anew or off
        heard_ns, before_ns = presence.heard_ns, self._updated_ns
        # after a stall of this site itself the peer's point is elsewhere: hold, then blend
        if before_ns is not None and now_ns - before_ns > rules.hold_after_ns:
            return Cause.STALLED
        if heard_ns is None or peer is None or not presence.peer_confirmed:
            return Cause.NO_PEER
        if now_ns - heard_ns > rules.hold_after_ns:
            return Cause.SILENT
        # the sample in use is older than the state heard, perhaps from before a reset
        if heard not in _PEER_FIT or peer.state not in _PEER_FIT:
            return Cause.PEER_UNFIT
        if anew or off:
            return Cause.PEER_ANEW if anew else Cause.PEER_OFF
        if late:
            return Cause.LATE
        return Cause.MARGIN if self._proven < rules.derate_to else None

    def _peer_says_stop(self, presence: PeerPresence) -> bool:
        return (
            self.state is not State.READY
            and presence.peer_confirmed
            and presence.heard_state == State.EMERGENCY_STOP
        )

    def _wait(
        self,
        now_ns: int,
        presence: PeerPresence,
        peer: PeerSample | None,
        own_m: FloatArray,
        trouble: Cause | None,
    ) -> None:
        """READY or ALIGNING: engage as soon as nothing speaks against it."""
        if trouble is not None or peer is None:
            self._go(State.READY, trouble or Cause.NO_PEER)
        elif now_ns < self._rules.not_before_ns:
            self._go(State.READY, Cause.NOT_YET)
        elif not self._aligned(presence, peer, own_m):
            self._go(State.ALIGNING, Cause.APART)
        else:
            self._go(State.ENGAGED, Cause.AGREED)
            self._engaged_ns = self._coupled_ns = now_ns
            self._scale = self._proven
            self._peer_anew = False
            self._resumed_ns = None

    def _aligned(self, presence: PeerPresence, peer: PeerSample, own_m: FloatArray) -> bool:
        """Whether the points are near enough; on the way, let a clutched site's offset follow."""
        # a peer that already follows would be pulled along
        if self._rules.leads and self._rules.clutched and presence.heard_state != State.ENGAGED:
            self.offset_m = own_m - peer.position_m
        self.apart_m = dist(own_m, peer.position_m + self.offset_m)
        return self.apart_m <= self._rules.align_within_m

    def _hold(self, now_ns: int, point_m: FloatArray | None, cause: Cause) -> None:
        self._go(State.HOLD, cause)
        self._held = self.target_m = point_m
        self._held_ns = now_ns

    def _let_go(self, now_ns: int, own_m: FloatArray) -> None:
        """Without a lease: lead the force away, then the outputs are off, and stay so."""
        rules = self._rules
        if self.state in _OUTPUTS_OFF:
            self._go(State.READY, Cause.UNLEASED)
            return
        if self.state is State.RELEASED:  # what force is left goes within the same time
            if self._gone(now_ns - self._released_ns) >= 1.0:
                self._go(State.READY, Cause.UNLEASED)
            return
        if self.state is State.ENGAGED:
            self._hold(now_ns, self.target_m, Cause.UNLEASED)
        release_ns = round(rules.release_s * 1e9)
        if self._left_ns(now_ns) > release_ns:
            self._held_ns = now_ns + release_ns - rules.stop_after_ns
            self.cause = Cause.UNLEASED
        if self._left_ns(now_ns) <= 0:
            self._go(State.READY, Cause.UNLEASED)

    def _try_to_resume(
        self,
        now_ns: int,
        presence: PeerPresence,
        peer: PeerSample | None,
        own_m: FloatArray,
        trouble: Cause | None,
    ) -> None:
        """HOLD: back to ENGAGED, or after too long to READY."""
        if self._left_ns(now_ns) <= round(self._rules.release_s * 1e9):
            if self._left_ns(now_ns) <= 0:  # until then the force goes, and does not come back
                self._go(State.READY, Cause.LONG_HOLD)
            return
        trouble = trouble or self._apart(presence, peer, own_m)
        if trouble is not None:
            self.cause = trouble
            return
        self._go(State.ENGAGED, Cause.AGREED)
        self._resumed_ns = now_ns
        self._peer_anew = False

    def _apart(
        self, presence: PeerPresence, peer: PeerSample | None, own_m: FloatArray
    ) -> Cause | None:
        """Return what forbids a driven site to couple again with a peer that is well.

        A peer that engages anew goes first: without outputs, its robot may fall.
        """
        if peer is None:
            return Cause.NO_PEER
        off = presence.heard_state in _OUTPUTS_OFF
        self._peer_anew = self._peer_anew or off
        if self._peer_anew and not self._aligned(presence, peer, own_m):
            return Cause.APART
        return Cause.PEER_OFF if off else None

    def _release(self, now_ns: int, own_m: FloatArray) -> None:
        """Open the clutch: the peer keeps the point it was told last."""
        self._told_m = own_m - self.offset_m
        self._released_share = self.force_share(now_ns)
        self._released_ns = now_ns
        self._go(State.RELEASED, Cause.CLUTCH)

    def _follow_the_hand(
        self,
        now_ns: int,
        presence: PeerPresence,
        peer: PeerSample | None,
        own_m: FloatArray,
        clutch: bool,
        trouble: Cause | None,
    ) -> None:
        """RELEASED: the hand moves the robot, not the point told to the peer."""
        self.offset_m = own_m - self._told_m
        if clutch or self._gone(now_ns - self._released_ns) < 1.0:
            return
        self._coupled_ns = now_ns
        self._resumed_ns = None
        trouble = trouble or self._apart(presence, peer, own_m)
        if trouble is None:
            self._go(State.ENGAGED, Cause.AGREED)
            self._peer_anew = False
        else:
            self._hold(now_ns, own_m, trouble)

    def _left_ns(self, now_ns: int) -> int:
        """Return how much longer this HOLD may last [ns]."""
        return self._held_ns + self._rules.stop_after_ns - now_ns

    def _gone(self, elapsed_ns: int) -> float:
        """Return how much of the force is gone after this time of release."""
        return smooth_ramp(elapsed_ns * 1e-9, self._rules.release_s)[0]

    def _move_scale(self, now_ns: int) -> None:
        """Let the share in force follow what is proven, at a limited rate; HOLD has no loop."""
        if self._proven == self._scale or self._updated_ns is None or self.state is State.HOLD:
            return
        falls = self._proven < self._scale
        over_s = self._rules.release_s if falls else self._rules.ramp_s
        step = (now_ns - self._updated_ns) * 1e-9 / over_s if over_s > 0.0 else 1.0
        if falls:
            self._scale = max(self._proven, self._scale - step)
        else:
            self._scale = min(self._proven, self._scale + step)

    def _blended(self, now_ns: int, position_m: FloatArray) -> FloatArray:
        """After HOLD, move from the held point to the peer's, so that the force does not jump."""
        if self._resumed_ns is None or self._held is None:
            return position_m
        share, _ = smooth_ramp((now_ns - self._resumed_ns) * 1e-9, self._rules.blend_s)
        if share >= 1.0:
            self._resumed_ns = None
            return position_m
        return self._held + share * (position_m - self._held)
