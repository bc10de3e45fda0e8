"""The send rate under a bottleneck: it falls with the queue, comes back, and is bounded."""

from collections import deque
from typing import Any

import numpy as np
import pytest

from channel.channel import Channel
from channel.send_rate import CALM_NS, EXCESS_NS, SendRate

MS = 1_000_000
S = 1_000_000_000
ZERO = np.zeros(2)
CLOCK_NS = -7_777 * S  # the peer's clock
WAY_NS = 30 * MS


def echo(rate: SendRate, now_ns: int, excess_ns: int) -> None:
    """My sample of 60 ms ago came to the peer so much later than the fastest."""
    sent_ns = now_ns - 60 * MS
    rate.heard(now_ns, sent_ns, sent_ns + WAY_NS + excess_ns + CLOCK_NS)


def test_it_halves_once_a_way_and_no_further_than_the_slowest() -> None:
    rate = SendRate(4 * MS, 20 * MS)
    echo(rate, 0, 0)
    echo(rate, 100 * MS, EXCESS_NS)
    assert rate.period_ns == 4 * MS, "at the bound, not beyond"
    echo(rate, 200 * MS, EXCESS_NS + 1)
    echo(rate, 299 * MS, EXCESS_NS + 1)
    assert rate.period_ns == 4 * MS, "a stall of a tenth of a second is no queue"
    echo(rate, 300 * MS, EXCESS_NS + 1)
    assert rate.period_ns == 8 * MS
    echo(rate, 310 * MS, 10 * EXCESS_NS)
    assert rate.period_ns == 8 * MS, "that was sent before the halving"
    for now_ms in range(360, 2000, 60):
        echo(rate, now_ms * MS, EXCESS_NS + 1)
    assert rate.period_ns == 20 * MS


def test_it_comes_back_a_step_each_calm_second() -> None:
    rate = SendRate(4 * MS, 32 * MS)
    echo(rate, 0, 0)
    for now_ms in (800, 900, 950, 990):
        echo(rate, now_ms * MS, 0 if now_ms == 950 else 2 * EXCESS_NS)
    assert rate.share == 0.5
    for now_ms in range(1010, 17_500, 10):
        # half the excess is no calm
        echo(rate, now_ms * MS, EXCESS_NS // 2 + 1 if now_ms == 1500 else 0)
        if now_ms == 2490:
            assert rate.share == 0.5
    assert rate.share == pytest.approx(0.5 + 15 / 32)
    for now_ms in range(17_500, 20_000, 10):
        echo(rate, now_ms * MS, 0)
    assert rate.share == 1.0
    assert rate.period_ns == 4 * MS


def test_a_path_that_became_longer_is_the_path_before_long() -> None:
    rate = SendRate(4 * MS, 32 * MS)
    for now_ms in range(0, 90_000, 10):
        echo(rate, now_ms * MS, 0 if now_ms < 1000 else 4 * EXCESS_NS)
        if now_ms == 5000:
            assert rate.period_ns == 32 * MS
    assert rate.share == 1.0


def test_a_repeated_echo_and_another_clock_say_nothing() -> None:
    rate = SendRate(4 * MS, 32 * MS)
    rate.heard(0, -60 * MS, CLOCK_NS)
    rate.heard(10 * MS, -60 * MS, CLOCK_NS + S)
    rate.reset()
    rate.heard(20 * MS, -50 * MS, CLOCK_NS + 100 * S)
    rate.heard(200 * MS, 150 * MS, CLOCK_NS + 100 * S + 200 * MS)
    assert rate.share == 1.0


def test_the_slowest_is_no_faster_than_the_fastest() -> None:
    with pytest.raises(ValueError, match=r"slowest_ns = 3"):
        SendRate(4, 3)
    fixed = SendRate(4 * MS, 4 * MS)
    echo(fixed, 0, 0)
    echo(fixed, S, S)
    echo(fixed, 2 * S, S)
    assert fixed.period_ns == 4 * MS


class Bottleneck:
    """One end of a path that carries so many packets a second, after a queue, in `way_ns`."""

    def __init__(self, carried_hz: float) -> None:
        self.carried_hz = carried_hz
        self.now_ns = 0
        self.inbox: deque[tuple[int, bytes]] = deque()
        self.peer: Bottleneck
        self._free_ns = 0

    def send(self, data: bytes) -> bool:
        self._free_ns = max(self._free_ns, self.now_ns) + round(1e9 / self.carried_hz)
        self.peer.inbox.append((self._free_ns + WAY_NS, data))
        return True

    def receive(self) -> list[bytes]:
        arrived = []
        while self.inbox and self.inbox[0][0] <= self.now_ns:
            arrived.append(self.inbox.popleft()[1])
        return arrived

    def peer_present(self) -> bool:
        return True

    def close(self) -> None: ...


class Path:
    """Two channels across a bottleneck each way, on two clocks."""

    def __init__(self, slowest_ns: int | None, carried_hz: float) -> None:
        self.ends = Bottleneck(carried_hz), Bottleneck(1e6)
        self.ends[0].peer, self.ends[1].peer = self.ends[1], self.ends[0]
        settings: dict[str, Any] = {
            "session_digest": 1, "dimension": 2, "send_period_ns": MS, "silence_ns": S,
            "session_start_ns": 0, "slowest_send_period_ns": slowest_ns,
        }  # fmt: skip
        self.sites = [Channel(self.ends[k], site=k, epoch=k + 1, **settings) for k in range(2)]
        self.clocks_ns = [0, CLOCK_NS]
        self.now_ns = 0

    def run(self, seconds: float) -> list[float]:
        """Return the age of what site 1 uses of site 0 at each tick [s]."""
        ages_s = []
        for _ in range(round(seconds * 1000)):
            self.now_ns += MS
            for k, site in enumerate(self.sites):
                self.ends[k].now_ns = self.now_ns
                own_ns = self.now_ns + self.clocks_ns[k]
                sample = site.latest(own_ns)
                if k and sample is not None:
                    ages_s.append((self.now_ns - (sample.stamp_ns - self.clocks_ns[0])) * 1e-9)
                site.send(own_ns, 2, ZERO, ZERO, ZERO)
        return ages_s


def test_a_queue_of_one_s_own_is_brought_down_and_the_rate_comes_back() -> None:
    path, plain = Path(30 * MS, 1e6), Path(None, 1e6)
    for one in (path, plain):
        one.run(1.0)
        one.ends[0].carried_hz = 250.0  # a quarter of what it sends
    worst_s, settled_s, plain_s = path.run(8.0), path.run(20.0), plain.run(4.0)
    assert plain_s[-1] > 2.5, "the queue grows without end"
    assert max(worst_s) < 1.6
    assert np.median(settled_s) < 0.05
    assert max(settled_s) < 0.03 + 4 * EXCESS_NS * 1e-9
    assert path.sites[0].slowed
    assert not path.sites[1].slowed, "nothing is in its packets' way"
    path.ends[0].carried_hz = 1e6
    path.run(32 * CALM_NS * 1e-9 + 1.0)
    assert not path.sites[0].slowed


def test_the_spacing_is_never_beyond_the_slowest() -> None:
    path = Path(5 * MS, 1e6)
    path.run(1.0)
    path.ends[0].carried_hz = 150.0  # no rate within the bound fits
    path.run(15.0)
    assert path.sites[0].send_period_ns == 5 * MS
    before = path.sites[0].counters.sent
    path.run(3.0)
    assert path.sites[0].counters.sent - before == pytest.approx(600, abs=2)


def test_a_peer_that_starts_anew_on_another_clock_slows_nothing() -> None:
    path = Path(30 * MS, 1e6)
    path.run(1.0)
    path.ends[1].inbox.clear()
    path.sites[1] = Channel(
        path.ends[1], site=1, epoch=99, session_digest=1, dimension=2, send_period_ns=MS,
        silence_ns=S, session_start_ns=0,
    )  # fmt: skip
    path.clocks_ns[1] += 1000 * S
    for _ in range(1000):  # long enough to be taken for another run
        path.now_ns += MS
        path.sites[0].latest(path.now_ns)
    path.run(2.0)
    assert path.sites[0].peer_confirmed
    assert path.sites[0].counters.peer_restarts == 1
    assert not path.sites[0].slowed
