"""Every row of the transition table at its edges, and what must hold whatever happens."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import inf
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.channel import Counters, PeerSample
from control_law.ramp import smooth_ramp
from site_runtime.supervisor import DRIVEN, STOPPED, Cause, EngagementRules, State, Supervisor

MS = 1_000_000
START = 1000 * MS
RULES = EngagementRules(
    not_before_ns=START,
    hold_after_ns=20 * MS,
    stop_after_ns=300 * MS,
    ramp_s=0.2,
    release_s=0.05,
    blend_s=0.1,
    align_within_m=0.02,
    derate_to=0.25,
    leads=True,
    clutched=False,
)
RELEASE, RAMP, BLEND = 50, 200, 100  # [ms]
FIT = (State.READY, State.ALIGNING, State.ENGAGED, State.HOLD, State.RELEASED)
UNFIT = (State.OFFLINE, State.FAULT, State.EMERGENCY_STOP)


@dataclass
class Presence:
    """What the channel knows of the peer; silent until heard."""

    heard_ns: int | None = None
    heard_state: int | None = None
    peer_confirmed: bool = True
    counters: Counters = field(default_factory=Counters)


class Side:
    """A supervisor, its own point, and the peer it is told of; a tick lets a millisecond pass.

    The peer is ENGAGED, at the very point, until a test says otherwise.
    """

    def __init__(self, **rules: Any) -> None:
        self.rules = replace(RULES, **rules)
        self.supervisor = Supervisor(self.rules, 2)
        self.presence = Presence()
        self.now_ns = START - MS
        self.own = np.zeros(2)
        self.peer: npt.NDArray[np.float64] | None = np.zeros(2)
        self.peer_state: int = State.ENGAGED
        self.sample_state: int | None = None

    def tick(self, ms: float = 1.0, *, heard: bool = True, **looks: Any) -> State:
        return self.tick_ns(round(ms * MS), heard=heard, **looks)

    def tick_ns(self, after_ns: int, *, heard: bool = True, **looks: Any) -> State:
        self.now_ns += after_ns
        if heard:
            self.presence.heard_ns = self.now_ns
            self.presence.heard_state = self.peer_state
        zero = np.zeros(2)
        state = self.peer_state if self.sample_state is None else self.sample_state
        sample = (
            None
            if self.peer is None
            else PeerSample(0, 0, 1, self.peer.copy(), zero, zero, state, None, 0)
        )
        return self.supervisor.update(self.now_ns, self.presence, sample, self.own, **looks)

    def ticks(self, count: int, **looks: Any) -> State:
        for _ in range(count):
            self.tick(**looks)
        return self.state

    @property
    def state(self) -> State:
        return self.supervisor.state

    @property
    def cause(self) -> Cause:
        return self.supervisor.cause

    @property
    def share(self) -> float:
        return self.supervisor.force_share(self.now_ns)

    @property
    def told(self) -> npt.NDArray[np.float64]:
        return self.supervisor.told_m(self.own)

    @property
    def target(self) -> list[float]:
        assert self.supervisor.target_m is not None
        return list(self.supervisor.target_m.tolist())


def ready(**rules: Any) -> Side:
    return Side(**rules)


def aligning(**rules: Any) -> Side:
    side = Side(**rules)
    side.peer = np.array([0.5, 0.0])
    assert side.tick() is State.ALIGNING
    return side


def engaged(**rules: Any) -> Side:
    """ENGAGED for so long that all of the force is there."""
    side = Side(**rules)
    side.ticks(RAMP + 2)
    assert (side.state, side.share) == (State.ENGAGED, 1.0)
    return side


def holding(**rules: Any) -> Side:
    """HOLD since this very tick."""
    side = engaged(**rules)
    side.peer_state = State.FAULT
    assert side.tick() is State.HOLD
    side.peer_state = State.ENGAGED
    return side


def released(**rules: Any) -> Side:
    """RELEASED since this very tick."""
    side = engaged(**rules)
    assert side.tick(clutch=True) is State.RELEASED
    return side


def faulty(**rules: Any) -> Side:
    side = engaged(**rules)
    side.supervisor.fault()
    return side


def emergency(**rules: Any) -> Side:
    side = engaged(**rules)
    side.tick(emergency_stop=True)
    return side


def ended(**rules: Any) -> Side:
    side = engaged(**rules)
    side.supervisor.stop()
    return side


IN = {
    State.OFFLINE: ended,
    State.READY: ready,
    State.ALIGNING: aligning,
    State.ENGAGED: engaged,
    State.HOLD: holding,
    State.RELEASED: released,
    State.FAULT: faulty,
    State.EMERGENCY_STOP: emergency,
}
WORKING = tuple(state for state in State if state is not State.OFFLINE and state not in STOPPED)


def test_the_states_here_are_what_they_say() -> None:
    assert {state: prepare().state for state, prepare in IN.items()} == {s: s for s in State}


# READY and ALIGNING


@pytest.mark.parametrize("peer_state", FIT)
def test_ready_engages_with_a_peer_that_is_heard_confirmed_and_well(peer_state: State) -> None:
    side = ready()
    side.peer_state, side.peer = peer_state, np.array([0.01, 0.0])
    assert (side.tick(), side.cause) == (State.ENGAGED, Cause.AGREED)
    assert side.target == [0.01, 0.0]
    assert side.supervisor.engaged_s(side.now_ns + 1500 * MS) == 1.5


def never_heard(side: Side) -> None:
    side.tick(heard=False)


def silent(side: Side) -> None:
    side.presence.heard_ns = side.now_ns - RULES.hold_after_ns
    side.presence.heard_state = State.ENGAGED
    side.tick_ns(1, heard=False)


def unconfirmed(side: Side) -> None:
    side.presence.peer_confirmed = False
    side.tick()


def without_a_sample(side: Side) -> None:
    side.peer = None
    side.tick()


def in_a_state(state: int) -> Callable[[Side], None]:
    def look(side: Side) -> None:
        side.peer_state = state
        side.tick()

    return look


def of_a_stopped_past(side: Side) -> None:
    side.sample_state = State.FAULT
    side.tick()


def started_anew(side: Side) -> None:
    side.presence.counters.peer_restarts += 1
    side.tick()


def gone_off(side: Side) -> None:
    side.tick()
    side.peer_state = State.READY
    side.tick()


def stalled(side: Side) -> None:
    side.tick()
    side.tick_ns(RULES.hold_after_ns + 1)


def late(side: Side) -> None:
    side.tick(late=True)


def beyond_the_margin(side: Side) -> None:
    side.tick(scale=0.2499)


TROUBLES: dict[str, tuple[Callable[[Side], None], Cause]] = {
    "never heard": (never_heard, Cause.NO_PEER),
    "silent": (silent, Cause.SILENT),
    "not confirmed": (unconfirmed, Cause.NO_PEER),
    "without a sample due": (without_a_sample, Cause.NO_PEER),
    "offline": (in_a_state(State.OFFLINE), Cause.PEER_UNFIT),
    "in fault": (in_a_state(State.FAULT), Cause.PEER_UNFIT),
    "of a state unknown": (in_a_state(77), Cause.PEER_UNFIT),
    "whose sample is of before its reset": (of_a_stopped_past, Cause.PEER_UNFIT),
    "started anew": (started_anew, Cause.PEER_ANEW),
    "stalled itself": (stalled, Cause.STALLED),
    "late itself": (late, Cause.LATE),
    "beyond the margin": (beyond_the_margin, Cause.MARGIN),
}
FOR_ENGAGED = {name: it for name, it in TROUBLES.items() if name != "never heard"} | {
    "whose outputs went off": (gone_off, Cause.PEER_OFF)
}


@pytest.mark.parametrize("why", [*TROUBLES, "emergency"])
@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_ready_stays_so_with_a_peer(why: str, apart: float) -> None:
    look, cause = TROUBLES.get(why, (in_a_state(State.EMERGENCY_STOP), Cause.PEER_UNFIT))
    side = ready(not_before_ns=0, align_within_m=-1.0) if why == "stalled itself" else ready()
    side.peer = np.array([apart, 0.0])
    look(side)
    assert (side.state, side.cause) == (State.READY, cause)
    assert side.supervisor.target_m is None


@pytest.mark.parametrize("why", TROUBLES)
def test_aligning_ends_with_a_peer(why: str) -> None:
    look, cause = TROUBLES[why]
    side = aligning()
    if why == "never heard":
        side.presence.heard_ns = None
    look(side)
    assert (side.state, side.cause) == (State.READY, cause)


def test_ready_waits_for_the_start_time() -> None:
    side = ready()
    side.now_ns = START - 2
    assert (side.tick_ns(1), side.cause) == (State.READY, Cause.NOT_YET)
    assert side.tick_ns(1) is State.ENGAGED


def test_points_just_within_are_aligned_and_any_further_apart_are_not() -> None:
    side = ready()
    side.peer = np.array([0.0, np.nextafter(0.02, 1.0)])
    assert (side.tick(), side.cause) == (State.ALIGNING, Cause.APART)
    assert side.supervisor.apart_m == pytest.approx(0.02)
    assert side.supervisor.target_m is None
    side.peer = np.array([0.0, 0.02])
    assert side.tick() is State.ENGAGED


def test_the_follower_never_moves_its_offset() -> None:
    side = ready(leads=False, clutched=True)
    side.peer = np.array([0.5, 0.0])
    assert side.tick() is State.ALIGNING
    assert side.told.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("peer_state", set(FIT) - {State.ENGAGED})
def test_a_clutched_site_takes_the_points_for_one_and_the_same(peer_state: State) -> None:
    side = ready(clutched=True)
    side.peer_state, side.peer, side.own = peer_state, np.array([0.5, 0.1]), np.array([0.2, 0.3])
    assert side.tick() is State.ENGAGED
    assert side.told == pytest.approx(side.peer)
    assert side.target == pytest.approx(side.own.tolist())


@pytest.mark.parametrize("prepare", [ready, holding])
def test_a_clutched_site_does_not_pull_along_a_peer_that_follows(
    prepare: Callable[..., Side],
) -> None:
    side = prepare(clutched=True)
    side.presence.counters.peer_restarts += prepare is holding
    side.peer_state, side.peer = State.ENGAGED, np.array([0.021, 0.0])
    before = side.state
    side.ticks(2)
    assert side.state is (State.ALIGNING if before is State.READY else State.HOLD)
    assert side.cause is Cause.APART
    assert side.told.tolist() == [0.0, 0.0]
    side.peer = np.array([0.019, 0.0])
    assert side.tick() is State.ENGAGED
    assert side.told.tolist() == [0.0, 0.0]


# ENGAGED


def test_engaged_follows_the_peer() -> None:
    side = engaged()
    for x in (0.01, 3.0, -2.0):
        side.peer = np.array([x, 0.0])
        assert side.tick() is State.ENGAGED
        assert side.target == [x, 0.0]


def test_engaged_holds_exactly_when_the_silence_is_longer_than_allowed() -> None:
    side = engaged()
    side.peer = np.array([2.0, 0.0])
    for _ in range(20):
        assert side.tick(heard=False) is State.ENGAGED
    side.peer = np.array([3.0, 0.0])
    assert (side.tick_ns(1, heard=False), side.cause) == (State.HOLD, Cause.SILENT)
    assert side.target == [2.0, 0.0]


@pytest.mark.parametrize("why", FOR_ENGAGED)
def test_engaged_holds_the_last_point_with_a_peer(why: str) -> None:
    look, cause = FOR_ENGAGED[why]
    side = engaged()
    side.peer = np.array([0.3, 0.0])
    side.tick()
    look(side)
    assert (side.state, side.cause) == (State.HOLD, cause)
    assert side.target == [0.3, 0.0]


def test_engaged_holds_and_blends_after_a_stall_longer_than_the_silence_allowed() -> None:
    side = engaged()
    assert side.tick_ns(RULES.hold_after_ns) is State.ENGAGED
    side.peer = np.array([9.0, 0.0])
    assert (side.tick_ns(RULES.hold_after_ns + 1), side.cause) == (State.HOLD, Cause.STALLED)
    assert side.tick() is State.ENGAGED
    assert side.target == [0.0, 0.0]


def test_a_loop_exactly_at_the_least_share_goes_on() -> None:
    side = engaged()
    assert side.tick(scale=0.25) is State.ENGAGED


def test_a_peer_that_does_not_drive_yet_is_followed() -> None:
    side = ready()
    side.peer_state = State.READY
    assert side.ticks(50) is State.ENGAGED
    side.peer_state = State.ENGAGED
    assert side.ticks(50) is State.ENGAGED
    side.peer_state = State.ALIGNING
    assert (side.tick(), side.cause) == (State.HOLD, Cause.PEER_OFF)


@pytest.mark.parametrize("proven", [0.9, 0.25])
def test_what_is_no_longer_proven_goes_in_its_time_and_what_is_again_comes_in_its(
    proven: float,
) -> None:
    side = engaged()
    falls = round((1.0 - proven) * RELEASE)
    for tick in range(1, falls):
        assert side.tick(scale=proven) is State.ENGAGED
        assert side.share == pytest.approx(1.0 - tick / RELEASE)
    side.ticks(2, scale=proven)
    assert side.share == proven
    for tick in range(1, round((1.0 - proven) * RAMP)):
        side.tick()
        assert side.share == pytest.approx(proven + tick / RAMP)
    side.ticks(2)
    assert side.share == 1.0


def test_without_ramp_or_release_the_share_follows_at_once() -> None:
    side = engaged(ramp_s=0.0, release_s=0.0)
    for proven in (0.5, 1.0, 0.3):
        side.tick(scale=proven)
        assert side.share == proven


def test_a_site_engages_with_what_is_proven() -> None:
    side = ready(ramp_s=0.0)
    side.tick(scale=0.4)
    assert (side.state, side.share) == (State.ENGAGED, 0.4)


# HOLD


@pytest.mark.parametrize("why", [*FOR_ENGAGED, "apart"])
def test_hold_stays_keeps_its_point_and_tells_why_with_a_peer(why: str) -> None:
    side = holding()
    look, cause = FOR_ENGAGED.get(why, (started_anew, Cause.APART))
    if why in ("apart", "stalled itself", "whose outputs went off"):
        side.presence.counters.peer_restarts += 1  # or it would resume before
        side.peer = np.array([0.5, 0.0])
        side.tick()
    look(side)
    if why == "apart":
        side.tick()
    assert (side.state, side.cause) == (State.HOLD, cause)
    assert side.target == [0.0, 0.0]
    assert side.share == 1.0


@pytest.mark.parametrize("how", ["anew", "outputs off"])
@pytest.mark.parametrize("peer_state", [State.READY, State.ALIGNING])
def test_a_peer_that_engages_anew_drives_and_is_aligned_before_it_is_followed(
    how: str, peer_state: State
) -> None:
    side = holding()
    side.peer_state, side.peer = peer_state, np.array([0.5, 0.0])
    side.presence.counters.peer_restarts += how == "anew"
    side.ticks(5)
    assert (side.state, side.cause, side.supervisor.apart_m) == (State.HOLD, Cause.APART, 0.5)
    side.peer = np.array([0.02, 0.0])
    assert (side.tick(), side.cause) == (State.HOLD, Cause.PEER_OFF)
    side.peer_state = State.ENGAGED
    side.peer = np.array([np.nextafter(0.02, 1.0), 0.0])
    assert (side.tick(), side.cause) == (State.HOLD, Cause.APART)
    side.peer = np.array([0.02, 0.0])
    assert side.tick() is State.ENGAGED


def test_a_clutched_hold_tells_a_peer_that_engages_anew_its_own_point() -> None:
    side = holding(clutched=True)
    side.peer_state = State.ALIGNING
    for x in (0.5, 0.4):
        side.peer = np.array([x, 0.1])
        side.own = side.own + 0.01
        assert (side.tick(), side.cause) == (State.HOLD, Cause.PEER_OFF)
        assert side.told == pytest.approx(side.peer)
    side.peer_state = State.ENGAGED
    assert side.tick() is State.ENGAGED
    assert side.target == [0.0, 0.0]  # from where it was held


def test_a_peer_started_anew_is_aligned_even_if_it_drives() -> None:
    side = holding()
    side.presence.counters.peer_restarts += 1
    side.peer_state, side.peer = State.HOLD, np.array([0.5, 0.0])
    assert side.ticks(5) is State.HOLD
    side.peer = np.array([0.0, 0.0])
    assert side.ticks(2) is State.ENGAGED
    side.peer = np.array([0.5, 0.0])  # once aligned, it is the same peer again
    side.tick(late=True)
    assert side.tick() is State.ENGAGED


def test_a_peer_that_was_only_silent_is_followed_wherever_it_is() -> None:
    side = holding()
    side.peer = np.array([0.5, 0.0])
    assert side.tick() is State.ENGAGED


def test_hold_ends_in_ready_exactly_after_stop_after() -> None:
    side = holding(ramp_s=0.0)
    since_ns = side.now_ns
    side.peer_state = State.FAULT
    side.ticks(299)
    assert side.tick_ns(MS - 1) is State.HOLD
    assert side.now_ns == since_ns + RULES.stop_after_ns - 1
    assert (side.tick_ns(1), side.cause) == (State.READY, Cause.LONG_HOLD)


def test_in_its_last_release_s_the_force_of_a_hold_goes_and_does_not_come_back() -> None:
    side = holding()
    side.peer_state = State.FAULT
    side.ticks(249)
    assert side.share == 1.0
    side.tick_ns(MS - 1)
    side.peer_state = State.ENGAGED
    assert side.tick_ns(1) is State.HOLD  # exactly release_s is left: too late
    for gone in range(1, RELEASE):
        assert side.tick() is State.HOLD
        assert side.share == pytest.approx(1.0 - smooth_ramp(gone * 1e-3, 0.05)[0])
    assert side.tick() is State.READY


def test_a_hold_resumes_up_to_release_s_before_its_end() -> None:
    side = holding()
    side.peer_state = State.FAULT
    side.ticks(249)
    side.peer_state = State.ENGAGED
    assert side.tick_ns(MS - 1) is State.ENGAGED


def test_after_a_long_hold_a_site_engages_anew_from_no_force() -> None:
    side = holding()
    side.peer_state = State.FAULT
    side.ticks(300)
    side.peer_state, side.peer = State.HOLD, np.array([0.01, 0.0])
    assert side.tick() is State.ENGAGED
    assert side.share == 0.0
    assert side.target == [0.01, 0.0]  # at once: without force there is nothing to blend
    assert side.supervisor.engaged_s(side.now_ns) == 0.0


def test_ramps_run_on_through_hold() -> None:
    side = engaged()
    at_ns = side.now_ns - round(side.supervisor.engaged_s(side.now_ns) * 1e9)
    side.tick(late=True)
    side.ticks(99, late=True)
    side.tick()
    assert side.supervisor.engaged_s(side.now_ns) == pytest.approx((side.now_ns - at_ns) * 1e-9)


@given(held=st.floats(-1.0, 1.0), back=st.floats(-1.0, 1.0), speed_m_s=st.floats(-0.5, 0.5))
def test_recovery_is_continuous_and_reaches_the_peer_after_the_blend(
    held: float, back: float, speed_m_s: float
) -> None:
    side = engaged()
    side.peer = np.array([held, 0.0])
    side.tick()
    side.tick(late=True)
    reach = abs(back - held) + abs(speed_m_s) * 0.1
    largest = (1.875 / 0.1 * reach + abs(speed_m_s)) * 1e-3  # the quintic's steepest slope
    before = held
    for tick in range(BLEND + 5):
        point = back + speed_m_s * tick * 1e-3
        side.peer = np.array([point, 0.0])
        assert side.tick() is State.ENGAGED
        if tick == 0:
            assert side.target[0] == held
        if tick == BLEND // 2:
            assert side.target[0] == pytest.approx((held + point) / 2)
        assert abs(side.target[0] - before) <= largest + 1e-12
        before = side.target[0]
        if tick >= BLEND:
            assert before == point


def test_a_second_outage_during_the_blend_holds_where_the_blend_was() -> None:
    side = holding()
    side.peer = np.array([1.0, 0.0])
    side.ticks(BLEND // 2 + 1)
    halfway = side.target[0]
    assert halfway == pytest.approx(0.5)
    side.tick(late=True)
    assert (side.state, side.target[0]) == (State.HOLD, halfway)
    assert side.tick() is State.ENGAGED
    assert side.target[0] == halfway


def test_without_a_blend_the_target_is_the_peers_at_once() -> None:
    side = holding(blend_s=0.0)
    side.peer = np.array([4.0, 0.0])
    side.tick()
    assert side.target == [4.0, 0.0]


# RELEASED


@pytest.mark.parametrize("prepare", [engaged, holding])
def test_the_local_operator_opens_the_clutch(prepare: Callable[..., Side]) -> None:
    side = prepare()
    assert (side.tick(clutch=True), side.cause) == (State.RELEASED, Cause.CLUTCH)


@pytest.mark.parametrize("prepare", [engaged, holding])
def test_the_remote_site_has_no_clutch(prepare: Callable[..., Side]) -> None:
    side = prepare(leads=False)
    assert side.tick(clutch=True) is State.ENGAGED


def test_released_the_hand_moves_and_the_point_told_stays() -> None:
    side = engaged()
    side.own = np.array([0.01, 0.0])
    side.tick(clutch=True)
    for x in (0.1, -0.3, 0.4):
        side.own = np.array([x, 0.0])
        side.tick(clutch=True)
        assert side.told.tolist() == [0.01, 0.0]
    side.ticks(RELEASE, clutch=True)
    assert side.share == 0.0
    assert side.tick() is State.ENGAGED
    assert side.told == pytest.approx([0.01, 0.0])
    assert side.target == pytest.approx([0.39, 0.0])
    side.own = side.own + 0.05
    side.tick()
    assert side.told == pytest.approx([0.06, 0.05])


def test_a_clutch_closed_early_waits_until_the_force_is_gone() -> None:
    side = released()
    for _ in range(RELEASE - 1):
        assert side.tick() is State.RELEASED
    assert side.tick() is State.ENGAGED
    assert side.share == 0.0
    side.ticks(RAMP // 2)
    assert side.share == pytest.approx(0.5)


def test_released_outlasts_silence_and_closes_into_hold_where_the_robot_is() -> None:
    side = released()
    for _ in range(500):
        side.tick(heard=False, clutch=True)
    assert side.state is State.RELEASED
    side.own = np.array([0.4, 0.1])
    assert (side.tick(heard=False), side.cause) == (State.HOLD, Cause.SILENT)
    assert side.target == [0.4, 0.1]
    assert side.share == 0.0


@pytest.mark.parametrize("clutched", [False, True])
def test_a_peer_that_engages_anew_meanwhile_is_aligned_when_the_clutch_closes(
    clutched: bool,
) -> None:
    side = released(clutched=clutched)
    side.presence.counters.peer_restarts += 1
    side.peer_state, side.peer = State.READY, np.array([0.5, 0.0])
    side.ticks(RELEASE, clutch=True)
    assert side.state is State.RELEASED
    assert side.tick() is State.HOLD
    if clutched:
        assert side.cause is Cause.PEER_OFF
        assert side.told == pytest.approx(side.peer)
    else:
        assert side.cause is Cause.APART
        assert side.told.tolist() == [0.0, 0.0]
    side.peer_state = State.ENGAGED
    assert side.tick() is (State.ENGAGED if clutched else State.HOLD)


def test_a_clutch_opened_in_the_last_release_s_of_a_hold_gives_no_force_back() -> None:
    side = holding()
    side.peer_state = State.FAULT
    side.ticks(300 - RELEASE // 2)
    before = side.share
    assert before == pytest.approx(0.5)
    side.tick(clutch=True)
    assert side.state is State.RELEASED
    assert side.share <= before


# latched


@pytest.mark.parametrize("state", WORKING)
def test_its_operator_stops_a_site_in_any_state(state: State) -> None:
    side = IN[state]()
    assert side.tick(emergency_stop=True) is State.EMERGENCY_STOP
    assert side.cause is Cause.OPERATOR


@pytest.mark.parametrize("state", WORKING)
@pytest.mark.parametrize("clutch", [False, True])
def test_a_peers_emergency_stop_stops_a_site_that_is_not_merely_ready(
    state: State, clutch: bool
) -> None:
    side = IN[state]()
    side.peer_state = State.EMERGENCY_STOP
    side.tick(clutch=clutch)
    if state is State.READY:
        assert (side.state, side.cause) == (State.READY, Cause.PEER_UNFIT)
    else:
        assert (side.state, side.cause) == (State.EMERGENCY_STOP, Cause.PEER_STOP)


@pytest.mark.parametrize("state", [State.ALIGNING, *DRIVEN])
def test_a_recording_stops_nobody(state: State) -> None:
    side = IN[state]()
    side.peer_state, side.presence.peer_confirmed = State.EMERGENCY_STOP, False
    side.tick()
    assert side.state not in STOPPED


@pytest.mark.parametrize("state", [*STOPPED, State.OFFLINE])
def test_what_is_latched_stays_until_it_is_reset(state: State) -> None:
    side = IN[state]()
    cause, target = side.cause, side.supervisor.target_m
    for looks in ({}, {"clutch": True}, {"emergency_stop": True}, {"scale": 0.0}):
        for peer_state in State:
            side.peer_state = peer_state
            assert side.tick(**looks) is state
    assert side.supervisor.target_m is target
    side.supervisor.stop()
    assert side.state is state
    assert side.cause is (Cause.ENDED if state is State.OFFLINE else cause)


@pytest.mark.parametrize("state", State)
def test_an_exception_is_a_fault_in_any_state_and_a_clean_end_is_offline(state: State) -> None:
    side = IN[state]()
    side.supervisor.stop()
    assert side.state is (state if state in STOPPED else State.OFFLINE)
    side.supervisor.fault()
    assert (side.state, side.cause) == (State.FAULT, Cause.FAILURE)


@pytest.mark.parametrize("state", State)
def test_a_reset_leaves_what_is_latched_and_nothing_else(state: State) -> None:
    side = IN[state]()
    side.supervisor.reset()
    if state not in STOPPED:
        assert side.state is state
        return
    assert (side.state, side.cause) == (State.READY, Cause.RESET)
    assert side.supervisor.target_m is None
    side.peer = np.array([0.01, 0.0])
    assert (side.tick(40), side.cause) == (State.READY, Cause.STALLED)
    assert side.tick() is State.ENGAGED
    assert side.share == 0.0
    assert side.target == [0.01, 0.0]


# what must hold whatever happens

RARELY = st.sampled_from([False] * 9 + [True])
# rare troubles, so that most of the time a site is driven, and comes back to be
EVENTS = st.fixed_dictionaries(
    {
        "after_ms": st.sampled_from([1] * 6 + [7, 20, 21, 30]),
        "repeat": st.integers(1, 80),
        "silent": RARELY,
        "state": st.sampled_from([State.ENGAGED] * 12 + [*State]),
        "recorded": RARELY,
        "restarted": RARELY,
        "absent": RARELY,
        "peer": st.floats(-0.02, 0.02) | st.floats(-0.05, 0.05),
        "hand": st.floats(-0.002, 0.002),
        "clutch": st.booleans(),
        "late": RARELY,
        "scale": st.just(1.0) | st.floats(0.25, 1.0) | st.floats(0.0, 1.0),
        "stop": RARELY,
        "fault": RARELY,
        "reset": st.booleans(),
    }
)
SCRIPTS = st.lists(EVENTS, min_size=1, max_size=20)
SIDES = st.fixed_dictionaries(
    {
        "leads": st.sampled_from([True, True, False]),
        "clutched": st.booleans(),
        "align_within_m": st.sampled_from([0.02, inf]),
    }
)


def play(
    script: list[dict[str, Any]], side: Side, before: Callable[[], None]
) -> Iterator[dict[str, Any]]:
    """Tick through a script; yields after each tick, `before` is called ahead of each."""
    for event in script:
        side.presence.peer_confirmed = not event["recorded"]
        side.presence.counters.peer_restarts += event["restarted"]
        side.peer_state = event["state"]
        side.peer = None if event["absent"] else np.array([event["peer"], 0.0])
        if event["reset"]:
            side.supervisor.reset()
        for step in range(event["repeat"]):
            side.own = side.own + np.array([event["hand"], 0.0])
            before()
            last = step == event["repeat"] - 1
            if event["fault"] and last:
                side.supervisor.fault()
            side.tick(
                event["after_ms"],
                heard=not event["silent"],
                clutch=event["clutch"],
                late=event["late"],
                scale=event["scale"],
                emergency_stop=event["stop"] and last,
            )
            yield event


@settings(deadline=None)
@given(script=SCRIPTS, rules=SIDES)
def test_torque_flows_only_after_a_confirmed_peer_that_is_well(
    script: list[dict[str, Any]], rules: dict[str, Any]
) -> None:
    side, proven = Side(**rules), False
    was, held = side.state, side.supervisor.target_m

    def note() -> None:
        nonlocal was, held
        was, held = side.state, side.supervisor.target_m

    for event in play(script, side, note):
        presence = side.presence
        well = (
            presence.heard_ns is not None
            and side.now_ns - presence.heard_ns <= RULES.hold_after_ns
            and presence.peer_confirmed
            and presence.heard_state in FIT
            and side.peer is not None
            and event["scale"] >= RULES.derate_to
            and not event["late"]
        )
        now = side.state
        # engagement is what opens the way; a latched state or a READY closes it again
        proven = (proven and now in DRIVEN) or well
        if now in DRIVEN:
            assert proven
            assert side.supervisor.target_m is not None
            assert side.now_ns >= START
        if now is State.ENGAGED:
            assert well
        if now is State.RELEASED:
            assert rules["leads"]
        if now is State.HOLD and was in (State.ENGAGED, State.HOLD):
            assert side.supervisor.target_m is held
        if was in STOPPED:
            assert now is was or (was is State.EMERGENCY_STOP and event["fault"])
        if now is State.READY and was in DRIVEN:
            assert (was, side.cause) == (State.HOLD, Cause.LONG_HOLD)


@settings(deadline=None)
@given(script=SCRIPTS, rules=SIDES, ramp_s=st.floats(0.05, 1.0), release_s=st.floats(0.02, 0.3))
def test_the_share_of_force_never_jumps_while_driven(
    script: list[dict[str, Any]], rules: dict[str, Any], ramp_s: float, release_s: float
) -> None:
    """No faster up than 2.875/ramp_s, no faster down than 1.875/release_s.

    The share is a product of factors within 0 and 1, so its change is at most the sum of theirs.
    Up: the ramp, whose steepest slope is 30/16 of 1/ramp_s, and the scale, 1/ramp_s. Down: in
    ENGAGED the scale alone, 1/release_s; in HOLD and RELEASED the scale rests, and the release goes
    at 30/16 of 1/release_s at most.
    """
    stop_after_ns = round(release_s * 1e9) + 40 * MS
    side = Side(**rules, ramp_s=ramp_s, release_s=release_s, stop_after_ns=stop_after_ns)
    was: tuple[State, float, int]

    def note() -> None:
        nonlocal was
        was = (side.state, side.share, side.now_ns)

    for _ in play(script, side, note):
        state, share, at_ns = was
        dt = (side.now_ns - at_ns) * 1e-9
        assert 0.0 <= side.share <= 1.0 or side.state not in DRIVEN
        if side.state not in DRIVEN:
            continue
        if state not in DRIVEN:
            assert side.share == 0.0
        else:
            assert side.share - share <= 2.875 / ramp_s * dt + 1e-12
            assert share - side.share <= 1.875 / release_s * dt + 1e-12


@settings(deadline=None)
@given(script=SCRIPTS, rules=SIDES)
def test_the_point_told_moves_with_the_hand_or_not_at_all(
    script: list[dict[str, Any]], rules: dict[str, Any]
) -> None:
    side = Side(**rules)
    was: tuple[State, Any, Any, Any]

    def note() -> None:
        nonlocal was
        was = (side.state, told, own, side.supervisor.offset_m.copy())

    told, own = side.told, side.own
    for event in play(script, side, note):
        before, told_before, own_before, offset = was
        told, own = side.told, side.own
        moved = np.linalg.norm(told - told_before)
        hand = np.linalg.norm(own - own_before)
        both = {before, side.state}
        if both == {State.RELEASED}:
            assert moved == 0.0
        elif both <= DRIVEN and (event["state"] == State.ENGAGED or both == {State.ENGAGED}):
            assert moved <= hand + 1e-12
        if not rules["leads"]:
            assert not side.supervisor.offset_m.any()
        if not rules["clutched"] and State.RELEASED not in both:
            assert np.array_equal(side.supervisor.offset_m, offset)
        if before is State.RELEASED and side.state is State.ENGAGED:
            # the error of the coupling is that between the peer and what it was told last
            error = np.array(side.target) - own
            assert side.peer is not None
            assert error == pytest.approx(side.peer - told, abs=1e-12)


@pytest.mark.parametrize("start", [State.READY, State.ENGAGED, State.HOLD])
def test_without_the_lease_the_force_goes_and_then_the_outputs(start: State) -> None:
    side = ready()
    if start is not State.READY:
        side.ticks(RAMP + 10)
        assert side.state is State.ENGAGED
    if start is State.HOLD:
        side.ticks(25, heard=False)
        assert side.state is State.HOLD
    shares = [side.share] if start is not State.READY else []
    for _ in range(RELEASE + 5):
        side.tick(unleased=True)
        if side.state in DRIVEN:
            shares.append(side.share)
    assert side.state is State.READY
    assert side.cause is Cause.UNLEASED
    if shares:
        assert shares[-1] < 0.01
        steepest = 1.875 / RELEASE + 1e-6
        assert all(0 <= before - after <= steepest for before, after in pairwise(shares))
    side.ticks(100, unleased=True)
    assert side.state is State.READY
    side.tick()
    assert side.state is State.ENGAGED


def test_a_lease_that_comes_back_does_not_stop_the_release() -> None:
    side = ready()
    side.ticks(RAMP + 10)
    side.tick(unleased=True)
    states = [side.tick() for _ in range(RELEASE + 5)]
    assert states[0] is State.HOLD
    assert State.READY in states
    first = states.index(State.READY)
    assert set(states[:first]) == {State.HOLD}


def test_the_end_of_the_lease_is_not_slower_than_the_end_of_a_long_hold() -> None:
    side = ready()
    side.ticks(RAMP + 10)
    side.ticks(20 + 300 - 10, heard=False)
    assert side.state is State.HOLD
    side.ticks(15, heard=False, unleased=True)
    assert side.state is State.READY


def test_an_open_clutch_ends_with_the_lease() -> None:
    side = ready()
    side.ticks(RAMP + 10)
    side.tick(clutch=True)
    assert side.state is State.RELEASED
    side.ticks(RELEASE + 2, clutch=True, unleased=True)
    assert side.state is State.READY


@pytest.mark.parametrize("unleased", [False, True])
def test_the_emergency_stop_comes_before_the_lease(unleased: bool) -> None:
    side = ready()
    side.ticks(RAMP + 10)
    side.tick(emergency_stop=True, unleased=unleased)
    assert side.state is State.EMERGENCY_STOP
