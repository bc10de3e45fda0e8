"""How often a site sends: less often while its packets pile up on their way."""

from typing import Final

EXCESS_NS: Final = 50_000_000
"""Time on the way above the least of late that is taken for a queue of one's own."""

LASTING_NS: Final = 100_000_000
"""So long at the least: a stall of either machine, or of a radio, is no queue."""

CALM_NS: Final = 1_000_000_000
"""So long without half of it, and the rate grows by a step."""

STEP: Final = 1 / 32
"""Of the full rate."""

FLOOR_NS: Final = 20_000_000_000
"""The least is of the last half to full of this: then a path that became longer is the path."""


class SendRate:
    """Halves when packets keep coming late to the peer; grows back step by step.

    What counts is the peer's arrival minus my stamp, of packets that it echoes: the way to the peer
    alone, on two clocks whose difference is in the least of late too. A halving must show in a
    packet sent after it before the next. Beyond a period of `slowest_ns` it does not go; one equal
    to `period_ns` fixes the rate. Real-time safe.
    """

    def __init__(self, period_ns: int, slowest_ns: int) -> None:
        if slowest_ns < period_ns:
            raise ValueError(f"slowest_ns = {slowest_ns} must be at least {period_ns}, the period")
        self._fastest_ns = period_ns
        self._least = period_ns / slowest_ns if slowest_ns else 1.0
        self._share = 1.0
        self.period_ns = period_ns
        self.reset()

    @property
    def share(self) -> float:
        """The present rate as a part of the full one."""
        return self._share

    def reset(self) -> None:
        """Forget the way: the peer has another clock. The rate stays."""
        self._newest_ns: int | None = None
        self._cut_ns: int | None = None
        self._late_ns: int | None = None
        self._calm_ns = 0
        self._since_ns = 0
        self._current_ns = 0
        self._before_ns = 0

    def heard(self, now_ns: int, echo_stamp_ns: int, echo_arrival_ns: int) -> None:
        """Take that my sample of `echo_stamp_ns` arrived at `echo_arrival_ns`, the peer's clock."""
        if self._newest_ns is not None and echo_stamp_ns <= self._newest_ns:
            return
        way_ns = echo_arrival_ns - echo_stamp_ns
        excess_ns = way_ns - self._floor_ns(now_ns, way_ns)
        if self._newest_ns is None or 2 * excess_ns > EXCESS_NS:
            self._calm_ns = now_ns
        self._newest_ns = echo_stamp_ns
        if excess_ns > EXCESS_NS:
            self._late_ns = now_ns if self._late_ns is None else self._late_ns
            lasting = now_ns - self._late_ns >= LASTING_NS
            if lasting and (self._cut_ns is None or echo_stamp_ns >= self._cut_ns):
                self._cut_ns = now_ns
                self._set(max(self._share / 2, self._least))
            return
        self._late_ns = None
        if self._share < 1.0 and now_ns - self._calm_ns >= CALM_NS:
            self._calm_ns = now_ns
            self._set(min(self._share + STEP, 1.0))

    def _floor_ns(self, now_ns: int, way_ns: int) -> int:
        """Least time on the way, in two halves of the window that take turns."""
        if self._newest_ns is None:
            self._since_ns = now_ns
            self._current_ns = self._before_ns = way_ns
        elif now_ns - self._since_ns >= FLOOR_NS // 2:
            self._since_ns = now_ns
            self._before_ns, self._current_ns = self._current_ns, way_ns
        elif way_ns < self._current_ns:
            self._current_ns = way_ns
        return min(self._current_ns, self._before_ns)

    def _set(self, share: float) -> None:
        self._share = share
        self.period_ns = round(self._fastest_ns / share)
