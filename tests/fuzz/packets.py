"""Mutated packets by the million, pushed into a channel in a live exchange.

    python -m tests.fuzz.packets --count 1000000 --seed 1

Each datagram is judged twice: by the channel, and by the reference that was written from
docs/packet.md. What the reference refuses goes to a listener whose twin hears the peer alone, and
both must stay bit-equal; every datagram must be counted, under the reference's reason. What it
takes for a packet of the peer (a forgery by one who knows session and run) goes to another
listener, which nothing may make raise. Any disagreement ends with the datagram and a traceback.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

import numpy as np

from channel.delay import ConstantDelay, Direction, SinusoidDelay
from channel.memory_link import memory_links
from channel.packet import Reject
from tests.fuzz.exchange import CAPACITY, DIMENSION, PEER, SESSION, Exchange, knowledge, listener
from tests.fuzz.layout import example
from tests.fuzz.mutations import mutated
from tests.fuzz.reference import reason

BATCH = 256
POOL = 64
FROM_FRESH = 0.5  # of the mutated: the older a packet, the sooner it is out of order
ALONE = 0.5  # of the batches end in a tick without the peer: nothing genuine hides a change
NEW_VICTIM = 0.1  # chance a tick: a lasting one stays misled, a new one is misled otherwise
SETTINGS: tuple[dict[str, Any], ...] = (
    {},
    {"shared_clock": True},
    {"direction": Direction(ConstantDelay(0.02)), "mode": "exact"},
    {"direction": Direction(SinusoidDelay(0.01, 0.01, 7.0)), "mode": "added"},
)
"""Each run goes through all of these."""


@dataclass(slots=True)
class Tally:
    """What was sent and what became of it."""

    rejected: Counter[Reject] = field(default_factory=Counter)
    forged: int = 0
    genuine: int = 0

    @property
    def hostile(self) -> int:
        """Datagrams sent that were not the peer's."""
        return self.rejected.total() + self.forged


class Victim:
    """A listener that hears forgeries too. It may be misled; it must count, and never raise."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._sender, own = memory_links(CAPACITY)
        self._channel = listener(own, **settings)
        self._sent = 0

    def hear(self, now_ns: int, batch: Sequence[bytes]) -> None:
        """Take a batch and use the channel as a site does."""
        for data in batch:
            self._sender.send(data)
        self._sent += len(batch)
        channel = self._channel
        sample = channel.latest(now_ns)
        if sample is not None:
            assert np.isfinite([sample.position_m, sample.velocity_m_s, sample.force_n]).all()
            _ = sample.age_ns * 1e-9, (sample.round_trip_ns or 0) * 1e-9
        knowledge(channel)
        rest = np.zeros(DIMENSION)
        assert channel.send(now_ns, 2, rest, rest, rest)
        self._sender.receive()
        counters = channel.counters
        assert counters.received + counters.rejected.total() == self._sent


def run(count: int, seed: int) -> Tally:
    """Send `count` hostile datagrams; AssertionError if one did what it should not."""
    rng = Random(seed)  # noqa: S311  to be repeated, not to be kept secret
    tally = Tally()
    for share, settings in enumerate(SETTINGS, start=1):
        _run(count * share // len(SETTINGS) - tally.hostile, rng, settings, tally)
    return tally


def _run(count: int, rng: Random, settings: dict[str, Any], tally: Tally) -> None:
    exchange = Exchange(**settings)
    other = example(3, site=PEER, session=SESSION, epoch=1000 + PEER, sequence=2**40)
    rejected: Counter[Reject] = Counter()
    victim = Victim(settings)
    while count > 0:
        exchange.speak()
        *_, previous, fresh = heard = exchange.heard[-POOL:]
        pool = [*heard, *exchange.said[-4:], other]
        size = min(BATCH, count)
        count -= size
        bases = [fresh if rng.random() < FROM_FRESH else rng.choice(heard) for _ in range(size)]
        batch = [mutated(rng, base, pool) for base in bases]
        hostile: list[list[bytes]] = []
        for newest, part in ((previous, batch[: size // 2]), (fresh, batch[size // 2 :])):
            reasons = [reason(data, exchange.receiver(newest)) for data in part]
            hostile.append([data for data, why in zip(part, reasons, strict=True) if why])
            rejected.update(why for why in reasons if why)
            tally.forged += reasons.count(None)
        if rng.random() < NEW_VICTIM:
            victim = Victim(settings)
        try:
            before, after = hostile
            if rng.random() < ALONE:
                exchange.listen(before)
                exchange.wait(after)
            else:
                exchange.listen(before, after)
            assert exchange.shaken.counters.rejected == rejected
            victim.hear(exchange.now_ns, [*batch, fresh])
        except Exception as failure:
            failure.add_note("\n".join(["this batch:", *(data.hex() for data in batch)]))
            raise
        tally.genuine += 1
    tally.rejected += rejected


def main() -> None:
    """Run from the command line and print what became of every datagram."""
    parser = argparse.ArgumentParser(description="Push mutated packets into a live channel.")
    parser.add_argument("--count", type=int, default=1_000_000, help="hostile datagrams to send")
    parser.add_argument(
        "--seed", type=int, default=time.time_ns() % 10**9, help="one seed, one run"
    )
    arguments = parser.parse_args()
    sys.stdout.write(f"seed {arguments.seed}\n")
    began_s = time.perf_counter()
    tally = run(arguments.count, arguments.seed)
    took_s = time.perf_counter() - began_s
    lines = [(why.value, tally.rejected[why]) for why in Reject]
    lines += [("forged: taken for the peer's", tally.forged), ("all", tally.hostile)]
    for name, number in lines:
        sys.stdout.write(f"{name:30}{number:12,}\n")
    sys.stdout.write(
        f"{tally.hostile / took_s:,.0f} packets/s, among {tally.genuine:,} genuine ones: "
        "no exception, and no change but by these\n"
    )


if __name__ == "__main__":
    main()
