"""Coverage-guided fuzzing of `decode` and `Channel.latest`; what follows `--` goes to libFuzzer.

    python -m tests.fuzz.atheris_packet -- -max_total_time=60

An input is a row of datagrams of one size. The mutator gives each a good checksum, or libFuzzer
would never get past it. atheris is optional: it has no wheel for every Python.
"""

import inspect
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from channel.channel import Channel
from channel.clock_offset import ClockOffset
from channel.delay import ConstantDelay, Direction
from channel.injection import Injection
from channel.memory_link import memory_links
from channel.packet import PacketError, decode
from tests.fuzz.exchange import CAPACITY, DIMENSION, MS, Exchange, knowledge, listener
from tests.fuzz.layout import SIZES, example, reencoded, resealed
from tests.fuzz.reference import reason_in_bytes

SIZE = SIZES[DIMENSION]
MOST_DATAGRAMS = 6
EXACT = {"direction": Direction(ConstantDelay(0.002)), "mode": "exact"}


def datagrams(data: bytes) -> list[bytes]:
    """Cut an input into datagrams; the last may be short."""
    return [data[start : start + SIZE] for start in range(0, len(data), SIZE)]


def check(data: bytes) -> None:
    """Decode an input, and let a channel hear it in the middle of an exchange."""
    _decode(data)
    parts = datagrams(data)[:CAPACITY]
    sender, own = memory_links(CAPACITY)
    channel = listener(own, **EXACT)
    rest = np.zeros(DIMENSION)
    for tick, part in enumerate(parts, start=1):
        _decode(part)
        sender.send(part)
        now_ns = tick * MS
        sample = channel.latest(now_ns)
        assert sample is None or np.isfinite(sample.position_m).all()
        knowledge(channel)
        assert channel.send(now_ns, 2, rest, rest, rest)
    counters = channel.counters
    assert counters.received + counters.rejected.total() == len(parts)


def _decode(data: bytes) -> None:
    try:
        packet, reason = decode(data), None
    except PacketError as error:
        packet, reason = None, error.reason
    assert reason is reason_in_bytes(data)
    assert packet is None or reencoded(packet) == data


def sealed(data: bytes) -> bytes:
    """Give every whole datagram of an input its checksum."""
    return b"".join(resealed(part) if len(part) == SIZE else part for part in datagrams(data))


def seeds() -> list[bytes]:
    """Return inputs to start from: a live exchange, and a packet of the other dimension."""
    exchange = Exchange()
    for _ in range(MOST_DATAGRAMS):
        exchange.tick()
    heard = exchange.heard
    return [heard[-1], b"".join(heard[-2:]), b"".join(heard[-MOST_DATAGRAMS:]), example(3)]


def main() -> None:
    """Fuzz until libFuzzer's limit; say so, and end well, where there is no atheris."""
    try:
        import atheris
    except ImportError:
        sys.stdout.write(
            "atheris is not installed (pip install atheris, where it has a wheel for this Python): "
            "coverage-guided fuzzing is left out\n"
        )
        return
    atheris.instrument_func(decode)
    for part in (Channel, ClockOffset, Injection):
        for member in vars(part).values():
            if inspect.isfunction(member):
                atheris.instrument_func(member)

    def mutator(data: bytes, max_size: int, seed: int) -> bytes:
        changed = atheris.Mutate(data, max_size)
        return sealed(changed) if seed % 8 else changed

    arguments = [argument for argument in sys.argv if argument != "--"]
    with tempfile.TemporaryDirectory(prefix="farhand-fuzz-") as corpus:
        for number, data in enumerate(seeds()):
            (Path(corpus) / str(number)).write_bytes(data)
        child = os.fork()  # libFuzzer leaves its process without a goodbye
        if child == 0:
            limit = f"-max_len={MOST_DATAGRAMS * SIZE}"
            atheris.Setup([*arguments, limit, corpus], check, custom_mutator=mutator)
            atheris.Fuzz()
        _, status = os.waitpid(child, 0)
    raise SystemExit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()
