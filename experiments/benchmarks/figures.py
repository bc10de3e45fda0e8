"""A figure of the page: ours and its yardstick of the same run, and what is to be reached."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite, nan

import numpy as np
import numpy.typing as npt


class BenchmarkError(Exception):
    """What keeps a figure from being measured here."""


class Verdict(StrEnum):
    """How far a figure came."""

    FURTHER = "reached, the next goal too"
    REACHED = "reached"
    MISSED = "not reached"
    STATED = "stated"


@dataclass(frozen=True, slots=True)
class Spread:
    """Percentiles of `count` samples."""

    p50: float
    p99: float
    p999: float
    count: int

    @classmethod
    def of(cls, samples: npt.ArrayLike) -> "Spread":
        """Return those of samples (n,); BenchmarkError if there are none."""
        values = np.asarray(samples, dtype=np.float64)
        if not values.size:
            raise BenchmarkError("no samples came")
        p50, p99, p999 = np.percentile(values, (50, 99, 99.9))
        return cls(float(p50), float(p99), float(p999), int(values.size))

    @property
    def percentiles(self) -> tuple[float, float, float]:
        """p50, p99 and p99.9."""
        return self.p50, self.p99, self.p999

    def over(self, other: "Spread") -> tuple[float, ...]:
        """Return the ratios, percentile by percentile; NaN over nothing."""
        pairs = zip(self.percentiles, other.percentiles, strict=True)
        return tuple(own / reference if reference > 0.0 else nan for own, reference in pairs)


@dataclass(frozen=True, slots=True)
class Goal:
    """A number to be at most, or at least, `reach`, and `then` further."""

    text: str
    value: float
    reach: float
    then: float
    at_least: bool = False

    @property
    def verdict(self) -> Verdict:
        """How far it came; a number that is not finite came nowhere."""
        sign = -1.0 if self.at_least else 1.0
        if not isfinite(self.value) or sign * self.value > sign * self.reach:
            return Verdict.MISSED
        return Verdict.REACHED if sign * self.value > sign * self.then else Verdict.FURTHER


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the page. Without goals it is stated only."""

    what: str
    against: str
    unit: str
    ours: Spread
    yardstick: Spread
    goals: tuple[Goal, ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """That of the goal which came least far."""
        order = (Verdict.MISSED, Verdict.REACHED, Verdict.FURTHER)
        return min((goal.verdict for goal in self.goals), key=order.index, default=Verdict.STATED)


@dataclass(frozen=True, slots=True)
class Unmeasured:
    """A line of the page that says why nothing stands in it."""

    what: str
    reason: str


@dataclass(frozen=True, slots=True)
class Effort:
    """How long is measured: seconds a subject, in so many turns, and what takes longest.

    `long_run_s` is how long memory and processor are watched, `pairs` are how many pairs of sites
    run at once, `rates_hz` the rates at which ticks are missed.
    """

    seconds: float
    turns: int
    rates_hz: tuple[int, ...]
    long_run_s: float
    pairs: tuple[int, ...]

    @property
    def turn_s(self) -> float:
        """Seconds of a subject in one turn."""
        return self.seconds / self.turns


FULL = Effort(60.0, 6, (1000, 2000, 4000), 600.0, (1, 2, 4, 8))
QUICK = Effort(5.0, 2, (1000, 2000, 4000), 20.0, (1, 4))
BRIEF = Effort(1.0, 1, (1000,), 1.0, (1, 2))
"""For the tests: that every figure can be measured, not what it is."""


@dataclass(frozen=True, slots=True)
class Benchmark:
    """What `farhand bench --only NAME` measures."""

    name: str
    what: str
    measure: Callable[[Effort], Iterator[Row | Unmeasured]]
