"""The offset between two monotonic clocks, from the stamps that packets carry anyway."""

from typing import NamedTuple

_DRIFT_DIVISOR = 10_000  # 100 ppm: two ordinary quartz clocks, 50 ppm each


class OffsetEstimate(NamedTuple):
    """A time on the peer's clock plus `offset_ns` is the time on mine, ± `uncertainty_ns`."""

    offset_ns: int
    uncertainty_ns: int


class ClockOffset:
    """Four-stamp minimum filter.

    No packet arrives before it was sent. So each one bounds the offset from above by (my arrival
    minus the peer's stamp), and the echo of one of mine bounds it from below by (my stamp minus the
    peer's arrival). The tightest of each are kept, which belong to the fastest packet each way and
    need not be of the same round trip; the offset is half-way, the uncertainty half the gap: never
    more than half the shortest round trip, however asymmetric the delays. As clocks may drift apart
    by up to 100 ppm, kept bounds widen at that rate, so an old one gives way to a fresh one by
    itself. Bounds that contradict each other say that a clock jumped: the filter starts again.
    """

    def __init__(self) -> None:
        self._lower_ns = 0
        self._upper_ns = 0
        self._updated_ns: int | None = None
        self.restarts = 0

    @property
    def offset_ns(self) -> int | None:
        """The present estimate [ns]; None before the first exchange."""
        if self._updated_ns is None:
            return None
        return (self._lower_ns + self._upper_ns) // 2

    def estimate(self, now_ns: int) -> OffsetEstimate | None:
        """Return the estimate with its uncertainty at `now_ns`; None before the first exchange."""
        lower_ns, upper_ns, updated_ns = self._lower_ns, self._upper_ns, self._updated_ns
        if updated_ns is None:
            return None
        uncertainty_ns = (upper_ns - lower_ns + 1) // 2
        if now_ns != updated_ns:
            uncertainty_ns += _drift_ns(now_ns - updated_ns)
        return OffsetEstimate((lower_ns + upper_ns) // 2, uncertainty_ns)

    def update(
        self, echo_stamp_ns: int, echo_arrival_ns: int, stamp_ns: int, arrival_ns: int
    ) -> None:
        """Take one exchange: sent (mine), arrived (peer's), sent back (peer's), arrived (mine)."""
        elapsed_ns = arrival_ns - echo_stamp_ns
        if elapsed_ns < 0 or stamp_ns < echo_arrival_ns:
            return  # an answer before its question: not stamps of one clock
        # the clocks have drifted since the peer heard me, at most this whole trip ago; since the
        # peer answered too, but by far less than the time on the way that the upper bound ignores
        lower_ns = echo_stamp_ns - echo_arrival_ns - _drift_ns(elapsed_ns)
        upper_ns = arrival_ns - stamp_ns
        if lower_ns > upper_ns:
            return
        if self._updated_ns is not None:
            drift_ns = _drift_ns(arrival_ns - self._updated_ns)
            kept_lower_ns = max(self._lower_ns - drift_ns, lower_ns)
            kept_upper_ns = min(self._upper_ns + drift_ns, upper_ns)
            if kept_lower_ns <= kept_upper_ns:
                lower_ns, upper_ns = kept_lower_ns, kept_upper_ns
            else:
                self.restarts += 1
        self._lower_ns, self._upper_ns = lower_ns, upper_ns
        self._updated_ns = arrival_ns

    def reset(self) -> None:
        """Forget everything: the peer has another clock."""
        self._updated_ns = None


def _drift_ns(elapsed_ns: int) -> int:
    return -(-elapsed_ns // _DRIFT_DIVISOR)  # rounded up, or a drift at the bound would escape
