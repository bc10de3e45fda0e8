from dataclasses import dataclass

import pytest

from site_runtime.clock import ManualClock
from site_runtime.link_keeper import LinkKeeper

S = 1_000_000_000


@dataclass
class Heard:
    """What a channel knows of its peer; times in ns."""

    heard_ns: int | None = None
    echoed_ns: int | None = None
    peer_taken: bool = False


@dataclass
class Watched:
    channel: Heard
    clock: ManualClock
    opened_s: list[float]

    def pass_time(self, until_s: int, *, speaks: bool, hears: bool) -> None:
        for half in range(2 * int(self.clock.now_ns() / S) + 1, 2 * until_s + 1):
            self.clock.sleep_until_ns(half * S // 2)
            if speaks:
                self.channel.heard_ns = self.clock.now_ns()
            if hears:
                self.channel.echoed_ns = self.clock.now_ns() - S // 10
            self.keeper.look()

    def __post_init__(self) -> None:
        self.keeper = LinkKeeper(
            self.channel,  # type: ignore[arg-type]
            lambda: self.opened_s.append(self.clock.now_ns() / S),
            self.clock,
        )


@pytest.fixture
def watched() -> Watched:
    return Watched(Heard(), ManualClock(), [])


def test_a_peer_that_speaks_and_does_not_hear_has_the_link_opened_anew_every_so_often(
    watched: Watched,
) -> None:
    watched.pass_time(10, speaks=True, hears=True)
    watched.pass_time(20, speaks=True, hears=False)
    assert watched.opened_s == [13.5, 16.5, 19.5]  # the last answer counts for a second
    watched.pass_time(30, speaks=True, hears=True)
    assert watched.opened_s == [13.5, 16.5, 19.5]


def test_one_that_has_never_heard_this_site_counts_as_well(watched: Watched) -> None:
    watched.pass_time(4, speaks=True, hears=False)
    assert watched.opened_s == [3.0]


def test_silence_is_no_reason_nor_is_a_peer_that_obeys_another(watched: Watched) -> None:
    watched.pass_time(10, speaks=False, hears=False)
    watched.channel.peer_taken = True
    watched.pass_time(20, speaks=True, hears=False)
    assert watched.opened_s == []


def test_a_peer_that_comes_and_goes_is_not_counted_together(watched: Watched) -> None:
    for minute in range(1, 10):
        watched.pass_time(10 * minute - 1, speaks=False, hears=False)
        watched.pass_time(10 * minute, speaks=True, hears=False)
    assert watched.opened_s == []
