"""What a network does to packets, as the session file describes it: delay, loss, order, copies.

The dataclasses are the session file's schema and nothing else; `injection` applies them. Times are
seconds of session time: zero at the session's start, negative before it.
"""

import bisect
import csv
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np

_MOST_S = 3600.0  # in nanoseconds, as the injection counts, a delay without limit overflows


def _require(condition: bool, key: str, value: object, allowed: str) -> None:
    if not condition:
        raise ValueError(f"{key} = {value!r} is not allowed: it must be {allowed}")


def _require_delay(key: str, value: float) -> None:
    _require(0.0 <= value <= _MOST_S, key, value, f"between 0 and {_MOST_S:g} s")


def _require_finite(key: str, value: float) -> None:
    _require(math.isfinite(value), key, value, "finite")


def _require_probability(key: str, value: float) -> None:
    _require(0.0 <= value <= 1.0, key, value, "a probability, between 0 and 1")


@dataclass(frozen=True, slots=True)
class ConstantDelay:
    """d(t) = delay_s [s]."""

    delay_s: float
    model: Literal["constant"] = "constant"

    def __post_init__(self) -> None:
        _require(self.model == "constant", "model", self.model, "'constant'")
        _require_delay("delay_s", self.delay_s)

    @property
    def bound_s(self) -> float:
        """The largest delay it can give [s]."""
        return self.delay_s

    def at(self, time_s: float, rng: np.random.Generator) -> float:
        """Return d(t) [s]."""
        return self.delay_s


@dataclass(frozen=True, slots=True)
class SinusoidDelay:
    """d(t) = mean_s + amplitude_s sin(angular_frequency_rad_s t + phase_rad) [s].

    The paper's simulation: 0.1 + 0.1 sin t.
    """

    mean_s: float
    amplitude_s: float
    angular_frequency_rad_s: float = 1.0
    phase_rad: float = 0.0
    model: Literal["sinusoid"] = "sinusoid"

    def __post_init__(self) -> None:
        _require(self.model == "sinusoid", "model", self.model, "'sinusoid'")
        _require_delay("mean_s", self.mean_s)
        _require(
            0.0 <= self.amplitude_s <= self.mean_s,
            "amplitude_s",
            self.amplitude_s,
            f"between 0 and mean_s = {self.mean_s!r}, or the delay would turn negative",
        )
        _require_finite("angular_frequency_rad_s", self.angular_frequency_rad_s)
        _require_finite("phase_rad", self.phase_rad)

    @property
    def bound_s(self) -> float:
        """The largest delay it can give [s]."""
        return self.mean_s + self.amplitude_s

    def at(self, time_s: float, rng: np.random.Generator) -> float:
        """Return d(t) [s]."""
        angle_rad = self.angular_frequency_rad_s * time_s + self.phase_rad
        # rounding may leave mean - amplitude a hair below zero
        return max(0.0, self.mean_s + self.amplitude_s * math.sin(angle_rad))


@dataclass(frozen=True, slots=True)
class UniformDelay:
    """A new, independent draw from [low_s, high_s] each time it is asked: a delay that jumps."""

    low_s: float
    high_s: float
    model: Literal["uniform"] = "uniform"

    def __post_init__(self) -> None:
        _require(self.model == "uniform", "model", self.model, "'uniform'")
        _require_delay("low_s", self.low_s)
        _require_delay("high_s", self.high_s)
        _require(
            self.low_s <= self.high_s, "low_s", self.low_s, f"at most high_s = {self.high_s!r}"
        )

    @property
    def bound_s(self) -> float:
        """The largest delay it can give [s]."""
        return self.high_s

    def at(self, time_s: float, rng: np.random.Generator) -> float:
        """Return one draw [s]."""
        return self.low_s + (self.high_s - self.low_s) * rng.random()


@dataclass(frozen=True, slots=True)
class TraceDelay:
    """A recorded delay, held between rows and repeated at its end.

    `path` is a CSV file with the columns time_s (increasing) and delay_s. The last row is held for
    as long as the one before it; a single row is a constant.
    """

    path: str
    model: Literal["trace"] = "trace"

    def __post_init__(self) -> None:
        _require(self.model == "trace", "model", self.model, "'trace'")
        _require(bool(self.path), "path", self.path, "the path of a CSV file")

    @property
    def bound_s(self) -> float:
        """The largest delay in the file [s]; ValueError if the file cannot be used."""
        return _read_trace(self.path).bound_s

    def at(self, time_s: float, rng: np.random.Generator) -> float:
        """Return d(t) [s]; ValueError if the file cannot be used."""
        return _read_trace(self.path).at(time_s)


DelayModel: TypeAlias = ConstantDelay | SinusoidDelay | UniformDelay | TraceDelay


@dataclass(frozen=True, slots=True)
class BurstLoss:
    """Gilbert–Elliott loss: a chain of good and bad stretches, advanced once a packet.

    Bursts last 1 / leave_burst packets in the mean and cover enter / (enter + leave) of them.
    """

    enter_burst: float
    leave_burst: float
    loss_in_burst: float = 1.0
    loss_outside: float = 0.0

    def __post_init__(self) -> None:
        _require_probability("enter_burst", self.enter_burst)
        _require_probability("leave_burst", self.leave_burst)
        _require_probability("loss_in_burst", self.loss_in_burst)
        _require_probability("loss_outside", self.loss_outside)


@dataclass(frozen=True, slots=True)
class Reordering:
    """Each packet is held back by extra_s [s] with this probability, so later ones overtake it."""

    probability: float
    extra_s: float

    def __post_init__(self) -> None:
        _require_probability("probability", self.probability)
        _require_delay("extra_s", self.extra_s)


@dataclass(frozen=True, slots=True)
class Duplication:
    """Each packet arrives twice with this probability."""

    probability: float

    def __post_init__(self) -> None:
        _require_probability("probability", self.probability)


@dataclass(frozen=True, slots=True)
class Direction:
    """Everything injected into one direction, local to remote or back."""

    delay: DelayModel
    loss: BurstLoss | None = None
    reordering: Reordering | None = None
    duplication: Duplication | None = None

    @property
    def bound_s(self) -> float:
        """The largest delay injected into a packet that is not lost [s].

        Loss adds one send period for each packet lost in a row, which nothing bounds; the network
        adds its own time.
        """
        extra_s = self.reordering.extra_s if self.reordering is not None else 0.0
        return self.delay.bound_s + extra_s

    def resolved(self, base_dir: Path) -> Self:
        """Return the same direction, a relative trace path taken as relative to `base_dir`."""
        if not isinstance(self.delay, TraceDelay):
            return self
        return replace(self, delay=replace(self.delay, path=str(base_dir / self.delay.path)))


@dataclass(frozen=True, slots=True)
class _Trace:
    times_s: tuple[float, ...]
    delays_s: tuple[float, ...]
    period_s: float
    bound_s: float

    def at(self, time_s: float) -> float:
        first_s = self.times_s[0]
        # counted from the first row: a recording need not start at zero
        replayed_s = first_s + (time_s - first_s) % self.period_s
        return self.delays_s[max(0, bisect.bisect_right(self.times_s, replayed_s) - 1)]


@lru_cache(maxsize=8)
def _read_trace(path: str) -> _Trace:
    try:
        if not Path(path).is_file():  # a device or a pipe may have no end
            raise OSError("there is no such file")
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path = {path!r} cannot be read as a delay trace: {error}") from error
    if not rows:
        raise ValueError(f"path = {path!r} holds no rows: a delay trace needs at least one")
    times_s: list[float] = []
    delays_s: list[float] = []
    for number, row in enumerate(rows, start=1):
        try:
            time_s, delay_s = float(row["time_s"]), float(row["delay_s"])
        except (KeyError, TypeError, ValueError):
            raise ValueError(
                f"path = {path!r}, row {number}: {row!r} must give a number for each of the "
                "columns time_s and delay_s"
            ) from None
        key = f"path = {path!r}, row {number}: "
        _require_finite(key + "time_s", time_s)
        _require_delay(key + "delay_s", delay_s)
        if times_s:
            _require(time_s > times_s[-1], key + "time_s", time_s, f"after {times_s[-1]!r}")
        times_s.append(time_s)
        delays_s.append(delay_s)
    last_s = times_s[-1] - times_s[-2] if len(times_s) > 1 else 1.0
    period_s = times_s[-1] - times_s[0] + last_s
    return _Trace(tuple(times_s), tuple(delays_s), period_s, max(delays_s))
