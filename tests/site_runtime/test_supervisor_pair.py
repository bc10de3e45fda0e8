"""Two supervisors against each other, over a link that delays what each tells the other."""

from collections import deque
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.channel import Counters, PeerSample
from site_runtime.supervisor import DRIVEN, STOPPED, Cause, EngagementRules, State, Supervisor

FloatArray = npt.NDArray[np.float64]
MS = 1_000_000
HOLD_AFTER, STOP_AFTER, RELEASE = 10, 60, 10  # [ticks of 1 ms]
RULES = EngagementRules(
    not_before_ns=0,
    hold_after_ns=HOLD_AFTER * MS,
    stop_after_ns=STOP_AFTER * MS,
    ramp_s=0.02,
    release_s=RELEASE * 1e-3,
    blend_s=0.02,
    align_within_m=0.02,
    derate_to=0.25,
    leads=True,
    clutched=False,
)
MEET = 2 * STOP_AFTER + 200
"""Ticks in which two healthy sites must meet: the rest of a HOLD, and a way to converge."""


@dataclass
class Word:
    """What one tick of a site says: its own run, the run of the peer it heard, state, point."""

    epoch: int
    answers: int
    state: State
    told_m: FloatArray


@dataclass
class End:
    """One site: a robot that goes where it is driven, and an ear with the channel's rules."""

    leads: bool
    alignment: str
    at: FloatArray
    epoch: int = 0
    supervisor: Supervisor = field(init=False)
    heard: Word | None = None
    heard_ns: int | None = None
    counters: Counters = field(default_factory=Counters)
    used: deque[Word] = field(default_factory=deque)
    clutch: bool = False
    scale: float = 1.0
    late: bool = False
    delay: int = 0

    def __post_init__(self) -> None:
        self.start(0.0)

    def start(self, shift_m: float) -> None:
        """Run anew, as another process; its robot may have been moved."""
        self.epoch += 1
        self.at = self.at + shift_m
        self.heard = self.heard_ns = None
        self.counters = Counters()
        self.used.clear()
        self.clutch = False
        self.supervisor = Supervisor(
            replace(
                RULES,
                leads=self.leads,
                clutched=self.alignment == "clutch",
                align_within_m=inf if self.alignment == "none" else RULES.align_within_m,
            ),
            1,
        )

    @property
    def heard_state(self) -> int | None:
        return None if self.heard is None else self.heard.state

    @property
    def peer_confirmed(self) -> bool:
        return self.heard is not None and self.heard.answers == self.epoch

    @property
    def state(self) -> State:
        return self.supervisor.state

    def hear(self, word: Word, now_ns: int) -> None:
        if self.heard is not None and word.epoch != self.heard.epoch:
            assert self.heard_ns is not None
            if now_ns - self.heard_ns < RULES.hold_after_ns:
                return
            self.counters.peer_restarts += 1
            self.used.clear()
        self.heard, self.heard_ns = word, now_ns
        self.used.append(word)

    def tick(self, now_ns: int) -> Word:
        while len(self.used) > self.delay + 1:
            self.used.popleft()
        sample = None
        if self.heard is not None and len(self.used) > self.delay:
            word, zero = self.used[0], np.zeros(1)
            sample = PeerSample(0, 0, 1, word.told_m, zero, zero, word.state, None, 0)
        if self.state not in STOPPED:
            self.supervisor.update(
                now_ns, self, sample, self.at, scale=self.scale, late=self.late, clutch=self.clutch
            )
        target = self.supervisor.target_m
        if self.state in DRIVEN and target is not None:
            step = 0.2 * self.supervisor.force_share(now_ns)
            self.at = self.at + step * (target - self.at)
        answers = 0 if self.heard is None else self.heard.epoch
        return Word(self.epoch, answers, self.state, self.supervisor.told_m(self.at))


class Pair:
    """Both sites; each hears the other `network` ticks late, and uses what it hears later still."""

    def __init__(self, alignment: str, *, apart_m: float, network: int, delay: int) -> None:
        self.local = End(True, alignment, np.array([apart_m]))
        self.remote = End(False, alignment, np.zeros(1), epoch=100)
        self.ends = (self.local, self.remote)
        self.local.delay = self.remote.delay = delay
        self._network = network
        self._way: tuple[deque[Word | None], deque[Word | None]] = (deque(), deque())
        self.broken = [False, False]
        self.now_ns = 0

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.now_ns += MS
            for way, end in zip(self._way, self.ends[::-1], strict=True):
                word = way.popleft() if len(way) > self._network else None
                if word is not None:
                    end.hear(word, self.now_ns)
            for index, end in enumerate(self.ends):
                word = end.tick(self.now_ns)
                self._way[index].append(None if self.broken[index] else word)

    def heal(self) -> None:
        """All is well again: links, loops, clutch; what is latched is reset."""
        self.broken[:] = False, False
        for end in self.ends:
            end.clutch, end.late, end.scale = False, False, 1.0
            end.supervisor.reset()

    @property
    def states(self) -> tuple[State, State]:
        return self.local.state, self.remote.state

    @property
    def error_m(self) -> float:
        """How far the remote robot is from where the local one says it should be."""
        return abs(float((self.local.supervisor.told_m(self.local.at) - self.remote.at)[0]))


BOTH_ENGAGED = (State.ENGAGED, State.ENGAGED)
WAYS = pytest.mark.parametrize(("network", "delay"), [(0, 0), (3, 0), (2, 7)])


@WAYS
def test_the_local_sites_clutch_aligns_the_remote_too(network: int, delay: int) -> None:
    pair = Pair("clutch", apart_m=0.5, network=network, delay=delay)
    pair.tick(30)
    assert pair.states == BOTH_ENGAGED
    pair.tick(100)
    assert pair.states == BOTH_ENGAGED
    assert pair.local.at == pytest.approx([0.5], abs=1e-6)  # neither had to move
    assert pair.remote.at == pytest.approx([0.0], abs=1e-6)


@WAYS
def test_checked_sites_stay_aligning_until_they_are_moved_together(
    network: int, delay: int
) -> None:
    pair = Pair("check", apart_m=0.5, network=network, delay=delay)
    pair.tick(200)
    assert pair.states == (State.ALIGNING, State.ALIGNING)
    assert pair.local.supervisor.apart_m == pair.remote.supervisor.apart_m == 0.5
    while pair.local.at[0] > 0.021:
        pair.local.at = pair.local.at - 0.001
        pair.tick()
        assert pair.states == (State.ALIGNING, State.ALIGNING)
    pair.local.at = np.array([0.019])
    pair.tick(100)
    assert pair.states == BOTH_ENGAGED


@pytest.mark.parametrize("who", ["local", "remote"])
@pytest.mark.parametrize("shift_m", [0.3, 0.005])
@WAYS
def test_a_site_restarted_in_another_pose_is_met_by_one_that_holds(
    who: str, shift_m: float, network: int, delay: int
) -> None:
    pair = Pair("clutch", apart_m=0.5, network=network, delay=delay)
    pair.tick(100)
    one = {"local": pair.local, "remote": pair.remote}[who]
    other = pair.ends[1 - pair.ends.index(one)]
    pair.broken[:] = True, True
    pair.tick(HOLD_AFTER + network + 2)
    assert other.state is State.HOLD
    stood = other.at.copy()
    one.start(shift_m)
    pair.broken[:] = False, False
    pair.tick(40)
    assert pair.states == BOTH_ENGAGED
    pair.tick(100)
    assert pair.states == BOTH_ENGAGED
    assert other.at == pytest.approx(stood, abs=RULES.align_within_m)


def test_a_checked_remote_restarted_elsewhere_is_waited_for_then_given_up() -> None:
    pair = Pair("check", apart_m=0.0, network=2, delay=3)
    pair.tick(100)
    assert pair.states == BOTH_ENGAGED
    pair.broken[:] = True, True
    pair.tick(HOLD_AFTER + 3)
    pair.remote.start(0.3)
    pair.broken[:] = False, False
    pair.tick(20)
    assert pair.states == (State.HOLD, State.ALIGNING)
    assert pair.local.supervisor.cause is Cause.APART
    pair.tick(STOP_AFTER)
    assert pair.states == (State.ALIGNING, State.ALIGNING)
    pair.remote.at = pair.local.at.copy()
    pair.tick(20)
    assert pair.states == BOTH_ENGAGED


def test_the_clutch_moves_the_hand_and_not_the_remote_robot() -> None:
    pair = Pair("clutch", apart_m=0.5, network=2, delay=3)
    pair.tick(100)
    stood = pair.remote.at.copy()
    pair.local.clutch = True
    pair.tick()
    for _ in range(100):
        pair.local.at = pair.local.at + 0.002
        pair.tick()
        assert pair.states == (State.RELEASED, State.ENGAGED)
    pair.local.clutch = False
    pair.tick(100)
    assert pair.states == BOTH_ENGAGED
    assert pair.remote.at == pytest.approx(stood, abs=1e-6)
    hand = pair.local.at + 0.01
    for _ in range(200):
        pair.local.at = hand
        pair.tick()
    assert pair.remote.at == pytest.approx(stood + 0.01, abs=1e-6)


@pytest.mark.parametrize("first", [0, 1])
def test_an_emergency_stop_at_one_stops_both_until_each_is_reset(first: int) -> None:
    pair = Pair("clutch", apart_m=0.5, network=2, delay=3)
    pair.tick(100)
    one, other = pair.ends[first], pair.ends[1 - first]
    one.supervisor.update(pair.now_ns, one, None, one.at, emergency_stop=True)
    pair.tick(10)
    assert pair.states == (State.EMERGENCY_STOP, State.EMERGENCY_STOP)
    assert {end.supervisor.cause for end in pair.ends} == {Cause.OPERATOR, Cause.PEER_STOP}
    other.supervisor.reset()
    pair.tick(50)
    assert (one.state, other.state) == (State.EMERGENCY_STOP, State.READY)
    one.supervisor.reset()
    pair.tick(50)
    assert pair.states == BOTH_ENGAGED


def test_a_site_that_follows_holds_when_the_other_switches_its_outputs_off() -> None:
    pair = Pair("clutch", apart_m=0.5, network=2, delay=3)
    pair.tick(100)
    pair.broken[1] = True  # the local site hears nothing, the remote one all is well
    pair.tick(HOLD_AFTER + STOP_AFTER - 5)
    assert pair.states == (State.HOLD, State.ENGAGED)
    pair.tick(20)
    assert pair.states == (State.READY, State.HOLD)
    pair.local.at = pair.local.at - 0.4  # an arm without outputs falls
    stood = pair.remote.at.copy()
    pair.tick(20)
    assert pair.remote.at == pytest.approx(stood, abs=1e-6)
    pair.heal()
    pair.tick(MEET)
    assert pair.states == BOTH_ENGAGED
    assert pair.remote.at == pytest.approx(stood, abs=RULES.align_within_m)


TROUBLES = st.fixed_dictionaries(
    {
        "what": st.sampled_from(
            [
                "to remote",
                "to local",
                "both",
                "restart",
                "fault",
                "stop",
                "reset",
                "heal",
                "clutch",
                "late",
                "margin",
                "hand",
            ]
        ),
        "which": st.integers(0, 1),
        "metres": st.floats(-0.3, 0.3),
        "ticks": st.integers(1, 90),
    }
)


def strike(pair: Pair, what: str, which: int, metres: float) -> None:
    end = pair.ends[which]
    match what:
        case "to remote":
            pair.broken[0] = not pair.broken[0]
        case "to local":
            pair.broken[1] = not pair.broken[1]
        case "both":
            pair.broken[:] = True, True
        case "restart":
            end.start(metres)
        case "fault":
            end.supervisor.fault()
        case "stop":
            end.supervisor.update(pair.now_ns, end, None, end.at, emergency_stop=True)
        case "reset":
            end.supervisor.reset()
        case "clutch":
            pair.local.clutch = not pair.local.clutch
        case "late":
            end.late = not end.late
        case "margin":
            end.scale = abs(metres)
        case "hand":
            end.at = end.at + 0.2 * metres
        case "heal":
            pair.heal()


@settings(deadline=None, max_examples=150)
@given(
    alignment=st.sampled_from(["clutch", "none"]),
    apart_m=st.floats(-0.5, 0.5),
    network=st.integers(0, 4),
    delay=st.integers(0, 6),
    script=st.lists(TROUBLES, max_size=12),
)
def test_there_is_no_deadlock(
    alignment: str, apart_m: float, network: int, delay: int, script: list[dict]
) -> None:
    """Once all is well, both engage and stay so, whatever went before; and the robots meet."""
    pair = Pair(alignment, apart_m=apart_m, network=network, delay=delay)
    for trouble in script:
        strike(pair, trouble["what"], trouble["which"], trouble["metres"])
        pair.tick(trouble["ticks"])
    pair.heal()
    pair.tick(50)
    pair.heal()  # an emergency stop that was on its way may have latched again
    pair.tick(MEET)
    for _ in range(20):
        assert pair.states == BOTH_ENGAGED
        pair.tick()
    pair.tick(200)
    assert pair.error_m < 1e-3
