from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from channel.channel import Counters
from channel.packet import Reject
from site_runtime.clock import ManualClock
from site_runtime.daemon_log import DaemonLog
from site_runtime.link_keeper import LONGEST_S, UNHEARD_S, LinkKeeper
from site_runtime.operator_requests import OperatorRequests

S = 1_000_000_000


@dataclass
class Watched:
    """A keeper, what its channel knows of the peer (times in ns), and the node."""

    clock: ManualClock = field(default_factory=ManualClock)
    heard_ns: int | None = None
    echoed_ns: int | None = None
    peer_taken: bool = False
    connected: bool = True
    there: bool | None = True
    """What is answered to whether the peer is there; None if nothing is."""
    opened_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.counters = Counters()
        self.requests = OperatorRequests()
        site = SimpleNamespace(channel=self, requests=self.requests)
        self.keeper = LinkKeeper(site, self, self, self.clock, DaemonLog("local"))

    def dialled(self) -> bool:
        return self.connected

    def reopen(self) -> None:
        self.opened_s.append(self.clock.now_ns() / S)

    def ask_for_peer(self, within_s: float) -> bool | None:
        assert within_s <= UNHEARD_S
        return self.there

    def pass_time(self, until_s: int, *, speaks: bool, hears: bool, refused: int = 0) -> None:
        for half in range(2 * int(self.clock.now_ns() / S) + 1, 2 * until_s + 1):
            self.clock.sleep_until_ns(half * S // 2)
            if speaks:
                self.heard_ns = self.clock.now_ns()
            if speaks and hears:
                self.echoed_ns = self.clock.now_ns() - S // 10
            for _ in range(refused):
                self.counters.reject(Reject.SESSION)
            self.keeper.look()


@pytest.fixture
def watched() -> Watched:
    return Watched()


@pytest.mark.parametrize("speaks", [False, True])
def test_a_peer_that_does_not_answer_has_the_link_opened_anew_less_and_less_often(
    watched: Watched, speaks: bool
) -> None:
    watched.pass_time(10, speaks=True, hears=True)
    watched.pass_time(40, speaks=speaks, hears=False)
    first = 10 + UNHEARD_S - 0.5 + UNHEARD_S  # the last answer counts for that long
    assert watched.opened_s == [first, first + 2 * UNHEARD_S, first + 6 * UNHEARD_S]
    watched.pass_time(50, speaks=True, hears=True)
    watched.pass_time(56, speaks=speaks, hears=False)
    assert watched.opened_s[3:] == [first + 40]
    watched.pass_time(600, speaks=speaks, hears=False)
    assert watched.opened_s[-1] - watched.opened_s[-2] == LONGEST_S


@pytest.mark.parametrize("there", [True, None])
def test_one_that_has_never_answered_counts_as_well(
    watched: Watched, there: bool | None, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.there = there
    watched.pass_time(4, speaks=False, hears=False)
    assert watched.opened_s == [UNHEARD_S]
    assert "opened anew" in capsys.readouterr().err


def test_one_that_is_not_there_is_no_reason_until_nobody_says_so(
    watched: Watched, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.pass_time(5, speaks=True, hears=True)
    watched.there = False
    watched.pass_time(200, speaks=False, hears=False)
    assert watched.opened_s == []
    assert capsys.readouterr().err == ""
    watched.there = None
    watched.pass_time(204, speaks=False, hears=False)
    assert len(watched.opened_s) == 1


def test_without_the_lease_the_peer_need_not_answer_but_the_connection_must(
    watched: Watched,
) -> None:
    watched.requests.unleased = True
    watched.pass_time(20, speaks=True, hears=False)
    assert watched.opened_s == []
    watched.there = None
    watched.pass_time(24, speaks=False, hears=False)
    assert len(watched.opened_s) == 1


def test_an_outage_is_waited_out(watched: Watched) -> None:
    watched.connected = False
    watched.pass_time(100, speaks=False, hears=False)
    assert watched.opened_s == []
    watched.connected = True
    watched.pass_time(102, speaks=False, hears=False)
    assert watched.opened_s == []


def test_a_peer_that_obeys_another_site_is_no_reason_while_it_is_heard(watched: Watched) -> None:
    watched.peer_taken = True
    watched.pass_time(20, speaks=True, hears=False)
    assert watched.opened_s == []
    watched.pass_time(26, speaks=False, hears=False)
    assert watched.opened_s == [20 + UNHEARD_S - 0.5 + UNHEARD_S]


def test_nor_is_a_peer_with_another_session(watched: Watched) -> None:
    watched.pass_time(20, speaks=False, hears=False, refused=1)
    assert watched.opened_s == []


def test_a_peer_that_comes_and_goes_is_not_counted_together(watched: Watched) -> None:
    for minute in range(1, 10):
        watched.connected = False
        watched.pass_time(10 * minute - 2, speaks=False, hears=False)
        watched.connected = True
        watched.pass_time(10 * minute, speaks=True, hears=False)
    assert watched.opened_s == []
