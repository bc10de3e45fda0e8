"""What a tick may cost, counted and not timed: a count is the same on a loaded machine.

The budgets hold what the remote site's tick took in ENGAGED when they were written, with little
room. A change that needs more of anything raises its budget, and says in docs/performance.md what
it bought; a change that needs less lowers it.
"""

import gc
import sys
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import pytest

from channel.memory_link import memory_links
from experiments.benchmarks.tick import DEMO, FOUR_LINKS
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.session import parse_session
from site_runtime.session_edit import edited
from site_runtime.supervisor import State

OPCODES = 7312
CALLS_INTO_C = 147
ROOM = 1.02
SETTLE_TICKS = 2500  # engaged, ramps over; two links are near the post
COUNTED_TICKS = 20
CUT_TICKS = 256


class Pair:
    """Both sites on a clock turned by hand; the remote robot has four joints and two sub-tasks."""

    def __init__(self) -> None:
        session = parse_session(edited(DEMO.read_text(encoding="utf-8"), FOUR_LINKS), DEMO)
        self._clock, self._period_ns = ManualClock(), session.period_ns
        local_link, remote_link = memory_links()
        self.local = build_local_site(
            session, Surroundings(local_link, self._clock, 0, 1, lambda _: None)
        )
        self.remote = build_remote_site(
            session, Surroundings(remote_link, self._clock, 0, 2, lambda _: None)
        )
        # the plant is not the tick's
        self.reads = self.remote._device.read
        self.remote._device.read = lambda: self._reading  # type: ignore[method-assign]
        for site in (self.local, self.remote):
            site.open()
        self._reading = self.reads()

    def before(self) -> None:
        """Move on to the next tick of the remote site."""
        self._clock.sleep_until_ns(self._clock.now_ns() + self._period_ns)
        self.local.tick()
        self.local.telemetry.flush()
        self._reading = self.reads()

    def run(self, ticks: int) -> None:
        """Let both tick."""
        for _ in range(ticks):
            self.before()
            self.remote.tick()
            self.remote.telemetry.flush()


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    found = Pair()
    found.run(SETTLE_TICKS)
    assert found.remote.state is State.ENGAGED
    yield found
    assert found.remote.state is State.ENGAGED
    assert found.remote.failure is None


def typical(pair: Pair, count: Callable[[Callable[[], None]], int]) -> int:
    """The median of some ticks: now and then one does more, such as cutting a list."""
    counts = []
    for _ in range(COUNTED_TICKS):
        pair.before()
        counts.append(count(pair.remote.tick))
        pair.remote.telemetry.flush()
    return sorted(counts)[COUNTED_TICKS // 2]


def opcodes(call: Callable[[], None]) -> int:
    """Bytecode instructions that a call executes."""
    executed = 0

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal executed
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        executed += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return executed


def calls_into_c(call: Callable[[], None]) -> int:
    """Functions written in C, pinocchio's and numpy's, that a call calls."""
    called = 0

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal called
        called += event == "c_call"

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(before)
    return called - 1  # setprofile itself


on_this_python = pytest.mark.skipif(
    sys.version_info[:2] != (3, 11), reason="the budgets were counted on CPython 3.11"
)


@on_this_python
def test_a_tick_takes_no_more_instructions_than_its_budget(pair: Pair) -> None:
    taken = typical(pair, opcodes)
    assert taken <= OPCODES * ROOM, f"{taken} instructions, {OPCODES} are allowed: see above"


@on_this_python
def test_a_tick_calls_into_c_no_more_often_than_its_budget(pair: Pair) -> None:
    called = typical(pair, calls_into_c)
    assert called <= CALLS_INTO_C, f"{called} calls, {CALLS_INTO_C} are allowed: see above"


def test_ticks_leave_nothing_behind(pair: Pair) -> None:
    """Memory is where it was after thousands of ticks; the collector, off in a daemon, is off."""
    gc.collect()
    gc.disable()
    try:
        pair.run(4 * CUT_TICKS)  # the collector emptied Python's free lists
        before = sys.getallocatedblocks()
        pair.run(12 * CUT_TICKS)  # each cut of the channel's list leaves as much as the one before
        assert sys.getallocatedblocks() - before < 12 * CUT_TICKS // 50
    finally:
        gc.enable()
