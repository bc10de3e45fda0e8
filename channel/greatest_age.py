"""The greatest age of the samples in use, over a time that moves on."""

from channel.packet import NO_AGE

WINDOW_NS = 1_000_000_000
_MOST_NS = 2**63 - 1


class GreatestAge:
    """Maximum over the last half to full `WINDOW_NS`, in two halves that take turns.

    Ages are differences of two clocks and may have any sign; `value_ns` is NO_AGE before the first.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the peer's clock may be another one now."""
        self._since_ns: int | None = None
        self._current_ns = NO_AGE
        self._before_ns = NO_AGE

    def add(self, now_ns: int, age_ns: int) -> None:
        """Take the age of the sample in use at `now_ns`, at most what a packet holds."""
        if self._since_ns is None:
            self._since_ns = now_ns
        elif now_ns - self._since_ns >= WINDOW_NS // 2:
            stale = now_ns - self._since_ns >= WINDOW_NS
            self._before_ns = NO_AGE if stale else self._current_ns
            self._current_ns = NO_AGE
            self._since_ns = now_ns if stale else self._since_ns + WINDOW_NS // 2
        if age_ns > self._current_ns:
            self._current_ns = min(age_ns, _MOST_NS)

    @property
    def value_ns(self) -> int:
        """The greatest age of late."""
        return max(self._current_ns, self._before_ns)
