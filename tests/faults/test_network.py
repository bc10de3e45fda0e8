"""The bad network does what it is told: seen by UDP from side 0 to side 1."""

import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from tests.faults import namespace
from tests.faults.companion import ROOT
from tests.faults.network import CLEAR, ImpairedNetwork, Impairment

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(namespace.refusal() is not None, reason=str(namespace.refusal() or "")),
]

PORT = 9000
SIZE = 156  # a pose packet of two dimensions


@dataclass
class Passed:
    """Numbers of the packets as they came, and the time each took [s]."""

    number: npt.NDArray[np.int64]
    took_s: npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def network() -> Iterator[ImpairedNetwork]:
    with ImpairedNetwork() as network:
        yield network


@pytest.fixture(autouse=True)
def clear(network: ImpairedNetwork) -> None:
    network.impair(CLEAR)


def send(network: ImpairedNetwork, count: int, *, rate_hz: float = 1000.0) -> Passed:
    """Send `count` numbered and stamped datagrams from side 0; wait until side 1 hears no more."""
    with ExitStack() as stack:
        sender, receiver = (stack.enter_context(network.datagram_socket(side)) for side in range(2))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.bind((network.address(1), PORT))
        receiver.settimeout(0.0)
        came = []

        def take(until_s: float) -> None:
            while (left_s := until_s - time.monotonic()) > 0.0:
                receiver.settimeout(left_s)
                try:
                    data = receiver.recv(2048)
                except (TimeoutError, BlockingIOError):
                    return
                number, stamp_ns = struct.unpack_from("<qq", data)
                came.append((number, (time.monotonic_ns() - stamp_ns) * 1e-9))

        start_s = time.monotonic()
        for number in range(count):
            packet = struct.pack("<qq", number, time.monotonic_ns()).ljust(SIZE, b"\0")
            sender.sendto(packet, (network.address(1), PORT))
            take(start_s + (number + 1) / rate_hz)
        take(time.monotonic() + 0.5)
    numbers, times_s = zip(*came, strict=True) if came else ((), ())
    return Passed(np.array(numbers, dtype=np.int64), np.array(times_s))


def test_a_clear_wire_keeps_up_with_more_than_the_sites_send(network: ImpairedNetwork) -> None:
    before_s = network.processor_s()
    passed = send(network, 4000, rate_hz=4000.0)
    assert np.array_equal(passed.number, np.arange(4000))
    assert np.median(passed.took_s) < 0.005
    assert network.processor_s() - before_s < 0.8


def test_delay_and_jitter_keep_the_order(network: ImpairedNetwork) -> None:
    network.impair(Impairment(delay_s=0.05, jitter_s=0.02))
    passed = send(network, 500, rate_hz=50.0 * 10)
    assert np.array_equal(passed.number, np.arange(500))
    assert passed.took_s.min() >= 0.030
    assert np.median(passed.took_s) < 0.09
    assert np.ptp(passed.took_s) > 0.01


def test_a_direction_is_impaired_alone(network: ImpairedNetwork) -> None:
    network.impair(Impairment(delay_s=0.2), sources=(1,))
    assert np.median(send(network, 50).took_s) < 0.1


def test_loss_is_of_the_share_asked_and_seeded(network: ImpairedNetwork) -> None:
    network.impair(Impairment(loss=0.2))
    assert 0.7 < len(send(network, 1000).number) / 1000 < 0.9
    arrived = []
    for _ in range(2):
        with ImpairedNetwork(seed=7) as another:
            another.impair(Impairment(loss=0.5))
            arrived.append(send(another, 64).number.tolist())
    assert arrived[0] == arrived[1]


def test_some_overtake_and_some_come_twice(network: ImpairedNetwork) -> None:
    network.impair(Impairment(delay_s=0.02, reorder=0.1))
    reordered = send(network, 500).number
    assert sorted(reordered) == list(range(500))
    assert 20 < np.count_nonzero(np.diff(reordered) < 0) < 80
    network.impair(Impairment(duplicate=0.1))
    numbers, times = np.unique(send(network, 500).number, return_counts=True)
    assert len(numbers) == 500
    assert 20 < np.count_nonzero(times == 2) < 80


def test_a_rate_limit_makes_a_queue(network: ImpairedNetwork) -> None:
    bits = 8 * (SIZE + 28)  # IP and UDP headers
    network.impair(Impairment(rate_bit_s=bits * 250.0))
    passed = send(network, 100, rate_hz=1000.0)
    assert np.array_equal(passed.number, np.arange(100))
    # the last one waits for 100 at 250 a second, less what it took to send them
    assert 0.2 < passed.took_s[-1] < 0.45


def test_a_blackout_swallows_all_and_ends(network: ImpairedNetwork) -> None:
    network.impair(Impairment(blackout=True))
    assert len(send(network, 100).number) == 0
    network.impair(CLEAR)
    assert len(send(network, 100).number) == 100


def test_nothing_stays_behind_when_its_owner_is_killed() -> None:
    code = (
        "import time; from tests.faults.network import ImpairedNetwork\n"
        "print(*ImpairedNetwork().names, flush=True); time.sleep(60)"
    )
    owner = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    with owner:
        assert owner.stdout is not None
        names = [Path("/run/netns") / name for name in owner.stdout.readline().split()]
        assert len(names) == 2
        assert all(name.exists() for name in names)
        os.kill(owner.pid, signal.SIGKILL)
    end_s = time.monotonic() + 20.0
    while any(name.exists() for name in names) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert not any(name.exists() for name in names)
