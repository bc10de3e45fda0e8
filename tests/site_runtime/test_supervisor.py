from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel.channel import Counters, PeerSample
from control_law.ramp import smooth_ramp
from site_runtime.supervisor import DRIVEN, EngagementTimes, State, Supervisor

MS = 1_000_000
START, HOLD_AFTER, BLEND_S = 50 * MS, 20 * MS, 0.1


@dataclass
class Presence:
    """A peer that was just heard, is confirmed and well."""

    heard_ns: int | None
    heard_state: int | None = State.READY
    peer_confirmed: bool = True
    counters: Counters = field(default_factory=Counters)


def sample(x: float = 0.0, y: float = 0.0) -> PeerSample:
    zero = np.zeros(2)
    return PeerSample(0, 1, np.array([x, y]), zero, zero, State.READY, None, 0)


def new_supervisor(blend_s: float = BLEND_S) -> Supervisor:
    return Supervisor(EngagementTimes(START, HOLD_AFTER, blend_s))


def engaged(blend_s: float = BLEND_S, x: float = 1.0) -> Supervisor:
    supervisor = new_supervisor(blend_s)
    supervisor.update(START, Presence(START), sample(x))
    assert supervisor.state is State.ENGAGED
    return supervisor


def holding(blend_s: float = BLEND_S, x: float = 1.0) -> Supervisor:
    supervisor = engaged(blend_s, x)
    supervisor.update(START + MS, Presence(START, State.OFFLINE), sample(x))
    assert supervisor.state is State.HOLD
    return supervisor


def target_x(supervisor: Supervisor) -> float:
    assert supervisor.target_m is not None
    return float(supervisor.target_m[0])


@pytest.mark.parametrize("peer_state", [State.READY, State.ENGAGED, State.HOLD])
def test_ready_engages_with_a_peer_that_is_heard_confirmed_and_well(peer_state: State) -> None:
    supervisor = new_supervisor()
    now_ns = START + HOLD_AFTER
    assert supervisor.update(now_ns, Presence(START, peer_state), sample(0.3)) is State.ENGAGED
    assert target_x(supervisor) == 0.3
    assert supervisor.engaged_s(now_ns + 1500 * MS) == 1.5


NOT_ENGAGING = {
    "never heard": (Presence(None, None, False), sample()),
    "silent": (Presence(START - HOLD_AFTER - 1), sample()),
    "not confirmed": (Presence(START, peer_confirmed=False), sample()),
    "offline": (Presence(START, State.OFFLINE), sample()),
    "in fault": (Presence(START, State.FAULT), sample()),
    "of a state unknown": (Presence(START, 77), sample()),
    "without a sample due": (Presence(START), None),
}


@pytest.mark.parametrize("why", NOT_ENGAGING)
def test_ready_never_engages_with_a_peer(why: str) -> None:
    presence, peer = NOT_ENGAGING[why]
    supervisor = new_supervisor()
    for _ in range(3):
        assert supervisor.update(START, presence, peer) is State.READY
    assert supervisor.target_m is None


def test_ready_waits_for_the_start_time() -> None:
    supervisor = new_supervisor()
    assert supervisor.update(START - 1, Presence(START - 1), sample()) is State.READY
    assert supervisor.update(START, Presence(START), sample()) is State.ENGAGED


def test_engaged_follows_the_peer() -> None:
    supervisor = engaged()
    for x in (1.0, 3.0, -2.0):
        assert supervisor.update(START, Presence(START), sample(x)) is State.ENGAGED
        assert target_x(supervisor) == x


def test_engaged_holds_exactly_when_the_silence_is_longer_than_allowed() -> None:
    supervisor, presence = engaged(), Presence(START)
    assert supervisor.update(START + HOLD_AFTER, presence, sample(2.0)) is State.ENGAGED
    assert supervisor.update(START + HOLD_AFTER + 1, presence, sample(3.0)) is State.HOLD
    assert target_x(supervisor) == 2.0


def test_engaged_holds_and_blends_after_a_stall_of_its_own() -> None:
    supervisor = engaged(x=1.0)
    late_ns = START + HOLD_AFTER
    assert supervisor.update(late_ns, Presence(late_ns), sample(2.0)) is State.ENGAGED
    late_ns += HOLD_AFTER + 1
    assert supervisor.update(late_ns, Presence(late_ns), sample(9.0)) is State.HOLD
    assert target_x(supervisor) == 2.0
    late_ns += MS
    assert supervisor.update(late_ns, Presence(late_ns), sample(9.0)) is State.ENGAGED
    assert target_x(supervisor) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(
    "presence",
    [
        Presence(START, State.FAULT),
        Presence(START, State.OFFLINE),
        Presence(START, peer_confirmed=False),
        Presence(START, counters=Counters(peer_restarts=1)),
    ],
    ids=["fault", "offline", "unconfirmed", "started anew"],
)
def test_engaged_holds_the_last_point_when_the_peer_is(presence: Presence) -> None:
    supervisor = engaged(x=1.0)
    assert supervisor.update(START, presence, sample(5.0)) is State.HOLD
    assert target_x(supervisor) == 1.0


@pytest.mark.parametrize("why", NOT_ENGAGING)
def test_hold_stays_and_keeps_its_point_with_a_peer(why: str) -> None:
    presence, peer = NOT_ENGAGING[why]
    supervisor = holding(x=1.0)
    for _ in range(3):
        assert supervisor.update(START, presence, peer) is State.HOLD
        assert target_x(supervisor) == 1.0
    assert supervisor.engaged_s(START + 400 * MS) == 0.4  # ramps run on


@given(held=st.floats(-1.0, 1.0), back=st.floats(-1.0, 1.0), speed_m_s=st.floats(-0.5, 0.5))
def test_recovery_is_continuous_and_reaches_the_peer_after_the_blend(
    held: float, back: float, speed_m_s: float
) -> None:
    supervisor = holding(x=held)
    steepest = 1.875 / BLEND_S  # of the quintic ramp
    reach = abs(back - held) + abs(speed_m_s) * BLEND_S
    largest = (steepest * reach + abs(speed_m_s)) * 1e-3
    before, resumed_ns = target_x(supervisor), START + 500 * MS
    for tick in range(round(BLEND_S * 1000) + 5):
        now_ns = resumed_ns + tick * MS
        point = back + speed_m_s * tick * 1e-3
        assert supervisor.update(now_ns, Presence(now_ns), sample(point)) is State.ENGAGED
        if tick == 0:
            assert target_x(supervisor) == held
        if tick == round(BLEND_S * 500):
            assert target_x(supervisor) == pytest.approx((held + point) / 2)
        assert abs(target_x(supervisor) - before) <= largest + 1e-12
        before = target_x(supervisor)
        if tick >= round(BLEND_S * 1000):
            assert before == point


def test_a_second_outage_during_the_blend_holds_where_the_blend_was() -> None:
    supervisor = holding(x=0.0)
    for tick in range(51):
        now_ns = START + (100 + tick) * MS
        supervisor.update(now_ns, Presence(now_ns), sample(1.0))
    halfway = target_x(supervisor)
    assert halfway == pytest.approx(smooth_ramp(0.05, BLEND_S)[0])
    assert supervisor.update(now_ns, Presence(now_ns, State.FAULT), sample(1.0)) is State.HOLD
    assert target_x(supervisor) == halfway
    later_ns = now_ns + 1000 * MS
    assert supervisor.update(later_ns, Presence(later_ns), sample(1.0)) is State.ENGAGED
    assert target_x(supervisor) == halfway


def test_without_a_blend_the_target_is_the_peers_at_once() -> None:
    supervisor = holding(blend_s=0.0, x=1.0)
    supervisor.update(START + 500 * MS, Presence(START + 500 * MS), sample(4.0))
    assert target_x(supervisor) == 4.0


@pytest.mark.parametrize("prepare", [new_supervisor, engaged, holding])
def test_a_fault_is_for_ever(prepare) -> None:
    supervisor = prepare()
    before = supervisor.target_m
    supervisor.fault()
    for now_ns in (START, START + MS, START + 10_000 * MS):
        assert supervisor.update(now_ns, Presence(now_ns), sample(9.0)) is State.FAULT
    supervisor.stop()
    assert supervisor.state is State.FAULT
    assert supervisor.target_m is before


@pytest.mark.parametrize("prepare", [new_supervisor, engaged, holding])
def test_a_clean_stop_is_offline_and_stays_so(prepare) -> None:
    supervisor = prepare()
    supervisor.stop()
    assert supervisor.update(START + MS, Presence(START + MS), sample()) is State.OFFLINE


EVENTS = st.fixed_dictionaries(
    {
        "after_ms": st.integers(1, 15),
        "heard": st.booleans(),
        "state": st.sampled_from(list(State)),
        "confirmed": st.booleans(),
        "restarted": st.sampled_from([False, False, False, True]),
        "x": st.none() | st.floats(-1.0, 1.0),
        "fault": st.sampled_from([False] * 19 + [True]),
    }
)


@given(events=st.lists(EVENTS, max_size=60))
def test_torque_flows_only_after_a_confirmed_peer_whatever_happens(events: list[dict]) -> None:
    supervisor, presence = new_supervisor(), Presence(None, None, False)
    now_ns, proven = 0, False
    for event in events:
        now_ns += event["after_ms"] * MS
        if event["heard"]:
            presence.heard_ns = now_ns
            presence.heard_state = event["state"]
            presence.peer_confirmed = event["confirmed"]
            presence.counters.peer_restarts += event["restarted"]
        peer = None if event["x"] is None else sample(event["x"])
        before, held = supervisor.state, supervisor.target_m
        if event["fault"]:
            supervisor.fault()
        state = supervisor.update(now_ns, presence, peer)
        well = (
            presence.heard_ns is not None
            and now_ns - presence.heard_ns <= HOLD_AFTER
            and presence.peer_confirmed
            and presence.heard_state in (State.READY, State.ENGAGED, State.HOLD)
        )
        proven = proven or (well and peer is not None and now_ns >= START)
        if state in DRIVEN:
            assert proven
            assert supervisor.target_m is not None
        if state is State.ENGAGED:
            assert well
        if state in (State.HOLD, State.FAULT):
            assert supervisor.target_m is held
        if before is State.FAULT:
            assert state is State.FAULT
        if before in DRIVEN:
            assert state is not State.READY
