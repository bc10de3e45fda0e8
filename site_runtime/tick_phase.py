"""When in its period a site ticks: right after the peer's packets, not right before them."""

_LATER, _EARLIER = 50, 1000  # parts of a period: then one packet in twenty just misses its tick
_LEAK = 10_000  # parts of a period a tick, 100 ppm: two clocks that drift apart
_MEMORY = 1000  # packets


class TickPhase:
    """Moves the ticks of one site so that packets hardly wait for the next.

    Two loops of one rate keep the phase that they started with, and a packet that just misses a
    tick waits for a whole period. So ticks come a little earlier with each packet, until one has
    been on its way for half a period longer than the fastest of late: it has missed its tick, and
    the next come later. Where packets come irregularly there is nothing to gain: beyond a period,
    ticks move by 100 ppm at most. Only one of two sites may do so.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._moved_ns = 0
        self._heard = 0
        self._fastest_ns: int | None = None
        self._fastest_before_ns = 0

    def step(self, way_ns: int | None) -> int:
        """Return by how much the next ticks come later [ns]; negative: earlier.

        `way_ns` is the longest way, from stamp to arrival, of the packets that came with this tick,
        the two clocks' difference included; None: none came.
        """
        period_ns = self._period_ns
        wanted_ns = 0
        if way_ns is not None:
            late = way_ns - self._fastest(way_ns) > period_ns // 2
            wanted_ns = period_ns // _LATER if late else -(period_ns // _EARLIER)
        leak_ns = period_ns // _LEAK
        moved_ns = self._moved_ns - max(-leak_ns, min(leak_ns, self._moved_ns))
        self._moved_ns = max(-period_ns, min(period_ns, moved_ns + wanted_ns))
        return self._moved_ns - moved_ns

    def _fastest(self, way_ns: int) -> int:
        """Return the shortest way of late, in two halves of the memory that take turns."""
        if self._fastest_ns is None:
            self._fastest_ns = self._fastest_before_ns = way_ns
        elif self._heard == _MEMORY:
            self._heard = 0
            self._fastest_before_ns, self._fastest_ns = self._fastest_ns, way_ns
        self._heard += 1
        self._fastest_ns = min(self._fastest_ns, way_ns)
        return min(self._fastest_ns, self._fastest_before_ns)
