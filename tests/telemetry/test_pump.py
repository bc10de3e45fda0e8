import threading
import time
from collections.abc import Callable

import pytest

from telemetry.pump import PERIOD_S, Pump
from telemetry.rows import TelemetryError

DEADLINE_S = 20.0


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_everything_offered_is_consumed_in_order_and_the_end_is_told_once() -> None:
    calls: list[tuple[list[int], bool]] = []
    pump = Pump[int]("test", lambda items, last: calls.append((items, last)))
    for item in range(300):
        pump.offer(item)
    assert pump.close(DEADLINE_S)
    assert [item for items, _ in calls for item in items] == list(range(300))
    assert [last for _, last in calls] == [False] * (len(calls) - 1) + [True]
    assert pump.dropped == 0
    assert pump.stalled_s() == 0.0


def test_what_is_offered_is_consumed_soon_but_not_in_many_pieces() -> None:
    calls: list[list[int]] = []
    pump = Pump[int]("test", lambda items, last: calls.append(items))
    time.sleep(3 * PERIOD_S)
    assert calls == []  # nothing to do
    began_s = time.monotonic()
    item = 0
    while time.monotonic() < began_s + 10 * PERIOD_S:
        pump.offer(item)
        item += 1
        time.sleep(0.001)
    assert pump.close(DEADLINE_S)
    assert [i for items in calls for i in items] == list(range(item))
    assert len(calls) <= (time.monotonic() - began_s) / PERIOD_S + 2


def test_an_idle_one_ends_at_once() -> None:
    calls: list[tuple[list[int], bool]] = []
    pump = Pump[int]("test", lambda items, last: calls.append((items, last)))
    assert pump.close(DEADLINE_S)
    assert calls == [([], True)]


def test_a_blocked_consumer_loses_the_oldest_and_the_producer_goes_on() -> None:
    blocked, release = threading.Event(), threading.Event()
    consumed: list[int] = []

    def consume(items: list[int], last: bool) -> None:
        consumed.extend(items)
        if items and not release.is_set():
            blocked.set()
            assert release.wait(DEADLINE_S)

    pump = Pump[int]("test", consume, capacity=10)
    pump.offer(-1)
    assert blocked.wait(DEADLINE_S)
    wait_for(lambda: pump.stalled_s() > 0.0)
    # Were offer to wait for the consumer, this would not end: the consumer is let go below.
    for item in range(1000):
        pump.offer(item)
    assert pump.dropped == 990
    assert pump.waiting == 10
    assert not pump.close(0.0)
    release.set()
    assert pump.close(DEADLINE_S)
    assert consumed == [-1, *range(990, 1000)]


def test_a_failed_consumer_is_told_to_the_producer() -> None:
    def consume(items: list[int], last: bool) -> None:
        raise ValueError("no such colour")

    pump = Pump[int]("test", consume)

    def refused() -> bool:
        try:
            pump.offer(1)
        except TelemetryError:
            return True
        return False

    wait_for(refused)
    with pytest.raises(TelemetryError, match="no such colour"):
        pump.offer(2)
    assert pump.close(DEADLINE_S)
