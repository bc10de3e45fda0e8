"""One who is on the network and has no business there: listens, plays back, floods."""

import itertools
import random
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Self

import numpy as np

from channel.packet import encode
from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import SiteId, state_key
from site_runtime.supervisor import State
from tests.faults.session import NAME

BURST_S = 0.001


class Intruder:
    """A peer that dials both sites and speaks on their keys."""

    def __init__(self, *endpoints: str) -> None:
        self._node = ZenohNode(ZenohSettings(connect=endpoints))
        self._publish = {site: self._node.publisher(state_key(NAME, site)) for site in SiteId}
        self._heard = {
            site: self._node.subscriber(state_key(NAME, site), 20_000) for site in SiteId
        }

    def record(self, site: SiteId, duration_s: float, within_s: float = 10.0) -> list[bytes]:
        """Return what a site says for a while from now on, or from when it is first heard."""
        self._heard[site].receive()
        end_s = time.monotonic() + within_s
        while not (heard := self._heard[site].receive()):
            if time.monotonic() > end_s:
                raise AssertionError(f"nothing heard of {site.label}")
            time.sleep(0.01)
        time.sleep(duration_s)
        heard += self._heard[site].receive()
        return [payload for _, payload in heard]

    def play(self, site: SiteId, packets: list[bytes], rate_hz: float = 1000.0) -> None:
        """Say these packets in a site's name, paced."""
        start_s = time.monotonic()
        for number, packet in enumerate(packets):
            time.sleep(max(start_s + number / rate_hz - time.monotonic(), 0.0))
            self._publish[site](packet)

    def flood(self, site: SiteId, packets: Iterator[bytes], rate_hz: float, for_s: float) -> float:
        """Say packets in a site's name at `rate_hz`, or as fast as it goes; return the rate."""
        publish = self._publish[site]
        burst = max(round(rate_hz * BURST_S), 1)
        start_s = now_s = time.monotonic()
        sent = 0
        while now_s - start_s < for_s:
            if sent <= rate_hz * (now_s - start_s):
                for packet in itertools.islice(packets, burst):
                    publish(packet)
                sent += burst
            else:
                time.sleep(BURST_S / 4)
            now_s = time.monotonic()
        return sent / (now_s - start_s)

    def close(self) -> None:
        """Go away."""
        self._node.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def nonsense(seed: int, site: SiteId, digest: int) -> Iterator[bytes]:
    """Packets without end: random bytes, and valid, cut and spoilt ones of runs that never were.

    The valid ones carry the session's digest and a point within the workspace; their sender knows
    neither site's epoch. Made in advance: making them must not slow the flood.
    """
    draw = random.Random(seed)  # noqa: S311  reproducible, not secret
    now_ns = time.monotonic_ns()
    made: list[bytes] = []
    for sequence in range(1, 1001):
        valid = encode(
            site=site,
            state=State["ENGAGED"],
            session=digest,
            epoch=draw.getrandbits(62) + 1,
            sequence=sequence,
            stamp_ns=now_ns + sequence,
            echo_epoch=draw.getrandbits(62) + 1,
            echo_stamp_ns=now_ns,
            echo_arrival_ns=now_ns,
            used_stamp_ns=now_ns,
            greatest_age_ns=0,
            vectors=np.array([[0.3, 0.3], [0.0, 0.0], [0.0, 0.0]]),
        )
        spoilt = bytearray(valid)
        spoilt[draw.randrange(len(valid))] ^= 1 << draw.randrange(8)
        cut = valid[: draw.randrange(len(valid))]
        made += [draw.randbytes(draw.randrange(400)), valid, cut, bytes(spoilt)]
    return itertools.cycle(made)
