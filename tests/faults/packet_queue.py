"""The wire of an `ImpairedNetwork`, a process: two TUN devices, a seeded queue each way.

Orders come as JSON lines on stdin, each answered by the CLOCK_MONOTONIC stamp [ns] from which it
holds. At the end of stdin, so also when its owner is killed, the namespaces are removed.
"""

import heapq
import json
import os
import random
import select
import sys
import time
from contextlib import suppress
from dataclasses import asdict, dataclass

from tests.faults import namespace

ADDRESSES = ("10.213.0.1", "10.213.0.2")
_CAPACITY = 1000  # packets that one direction holds; a full queue drops what comes
_READS = 64  # packets taken at once, before those due leave
_LARGEST = 65_535
_PRIORITY = 70  # below the daemons' loops, above their network threads


@dataclass(frozen=True, slots=True)
class Impairment:
    """What one direction does to its packets; the default lets them pass at once.

    `delay_s` ± `jitter_s` (uniform) keeps the order. With the probabilities: `loss` drops,
    `duplicate` doubles, `reorder` lets a packet overtake all that waits. `rate_bit_s` is a
    bottleneck with a queue before it. A `blackout` swallows all, what is on the way included.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    reorder: float = 0.0
    duplicate: float = 0.0
    rate_bit_s: float | None = None
    blackout: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.jitter_s <= self.delay_s:
            raise ValueError(f"jitter_s = {self.jitter_s} must be from 0 to delay_s")
        for name in ("loss", "reorder", "duplicate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} = {getattr(self, name)} is no probability")


class Direction:
    """One way through the wire."""

    def __init__(self, seed: str) -> None:
        self.impairment = Impairment()
        self.dropped = 0
        self._random = random.Random(seed)  # noqa: S311  reproducible, not secret
        self._waiting: list[tuple[int, int, bytes]] = []
        self._count = 0
        self._last_ns = 0
        self._free_ns = 0

    @property
    def due_ns(self) -> int | None:
        """When the next packet leaves; None if none waits."""
        return self._waiting[0][0] if self._waiting else None

    def enter(self, packet: bytes, now_ns: int) -> None:
        """Take a packet in."""
        how, draw = self.impairment, self._random.random
        # drawn for every packet: changing one effect leaves the draws of the others as they were
        lost, doubled, overtakes = (
            draw() < chance for chance in (how.loss, how.duplicate, how.reorder)
        )
        shift_s = self._random.uniform(-how.jitter_s, how.jitter_s)
        if how.blackout or lost or len(self._waiting) >= _CAPACITY:
            self.dropped += 1
            return
        due_ns = now_ns
        if how.rate_bit_s is not None:
            self._free_ns = max(self._free_ns, now_ns) + round(8e9 * len(packet) / how.rate_bit_s)
            due_ns = self._free_ns
        if not overtakes:
            due_ns = max(due_ns + round((how.delay_s + shift_s) * 1e9), self._last_ns)
            self._last_ns = due_ns
        for _ in range(1 + doubled):
            heapq.heappush(self._waiting, (due_ns, self._count, packet))
            self._count += 1

    def leave(self, now_ns: int) -> list[bytes]:
        """Return the packets that are due."""
        packets = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            packets.append(heapq.heappop(self._waiting)[2])
        return packets

    def change(self, impairment: Impairment) -> None:
        """Take another impairment; what waits keeps its time, but for a blackout."""
        self.impairment = impairment
        self._last_ns = 0
        self._free_ns = 0
        if impairment.blackout:
            self.dropped += len(self._waiting)
            self._waiting.clear()


class Wire:
    """Both directions between two TUN devices, and the orders on stdin."""

    def __init__(self, devices: tuple[int, int], seed: int) -> None:
        self._devices = devices
        self._directions = tuple(Direction(f"{seed}/{source}") for source in range(2))

    def run(self) -> None:
        """Carry packets until stdin ends."""
        watched = [*self._devices, sys.stdin.fileno()]
        while True:
            ready, _, _ = select.select(watched, [], [], self._idle_s())
            for source, device in enumerate(self._devices):
                if device in ready:
                    self._take(source, device)
            for source, direction in enumerate(self._directions):
                for packet in direction.leave(time.monotonic_ns()):
                    with suppress(OSError):  # the far device drops what it has no room for
                        os.write(self._devices[1 - source], packet)
            if sys.stdin.fileno() in ready and not self._obey():
                return

    def _idle_s(self) -> float | None:
        due = [d.due_ns for d in self._directions if d.due_ns is not None]
        return max(min(due) - time.monotonic_ns(), 0) * 1e-9 if due else None

    def _take(self, source: int, device: int) -> None:
        direction = self._directions[source]
        with suppress(BlockingIOError):
            for _ in range(_READS):
                direction.enter(os.read(device, _LARGEST), time.monotonic_ns())

    def _obey(self) -> bool:
        line = sys.stdin.buffer.readline()
        if not line:
            return False
        order = json.loads(line)
        for source in order["sources"]:
            self._directions[source].change(Impairment(**order["impairment"]))
        dropped = [direction.dropped for direction in self._directions]
        sys.stdout.write(json.dumps({"since_ns": time.monotonic_ns(), "dropped": dropped}) + "\n")
        sys.stdout.flush()
        return True


def order(sources: tuple[int, ...], impairment: Impairment) -> str:
    """Return the line that gives these directions an impairment."""
    return json.dumps({"sources": sources, "impairment": asdict(impairment)}) + "\n"


def main(names: tuple[str, str], seed: int) -> None:
    """Make both namespaces and the wire between them; carry until stdin ends; remove them."""
    made: list[str] = []
    try:
        for name in names:
            namespace.create(name)
            made.append(name)
        first, second = (
            namespace.open_tun(name, "farhand0", f"{address}/30")
            for name, address in zip(names, ADDRESSES, strict=True)
        )
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        Wire((first, second), seed).run()
    finally:
        for name in made:
            namespace.delete(name)


if __name__ == "__main__":
    main((sys.argv[1], sys.argv[2]), int(sys.argv[3]))
