"""What would certify a session that is not: the smallest changes, in the session file's keys."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt

from channel.delay import ConstantDelay, SinusoidDelay, UniformDelay
from control_law.certificates import (
    relaxation_theorem_a,
    relaxation_theorem_b,
    required_relaxation,
    required_scale,
)
from control_law.sampling import ADVISED_FILTER_RATIO, ADVISED_RATIO
from site_runtime.certification import (
    Certification,
    DampingLimit,
    certify,
    damping_limit,
    hold_of,
    injected_round_trip_s,
    pose_search,
    site_gains,
)
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of
from site_runtime.pose_search import FastestMode, PoseSearch
from site_runtime.rounding import rounded_down, rounded_up
from site_runtime.session import DampingSettings, PaperCoupling, Session
from site_runtime.session_checks import DIRECTIONS
from site_runtime.session_settings import MOST_HZ

FloatArray = npt.NDArray[np.float64]
Value = float | int | tuple[float, ...]

_STRICTLY = 1.0 + 1e-9  # a certificate wants more than equality
_ROUNDING = 0.99  # three digits move a number by less


class Means(Enum):
    """What a remedy changes."""

    TASK_DAMPING = "task damping"
    JOINT_DAMPING = "joint damping"
    STIFFNESS = "stiffness"
    ROUND_TRIP = "round trip"


@dataclass(frozen=True, slots=True)
class Change:
    """A key of the session file, its value, and its new value."""

    key: str
    old: Value
    new: Value

    @property
    def raised(self) -> bool:
        """Whether the numbers grow."""
        return bool(np.any(np.greater(self.new, self.old)))

    @property
    def relative(self) -> float:
        """The greatest change of a number, over the larger of old and new: 1 is from nothing."""
        old, new = (np.atleast_1d(np.asarray(value, dtype=float)) for value in (self.old, self.new))
        moved = old != new
        larger = np.maximum(old[moved], new[moved])
        return float(np.max(np.abs(new - old)[moved] / larger, initial=0.0))


@dataclass(frozen=True, slots=True)
class Overload:
    """Damping beyond what a site's rate or velocity filter carries as advised.

    `mode` is the fastest with it. `carried` is the most that they carry of `key`, in the same
    proportions; None if the rest of the damping is too much already.
    """

    limit: DampingLimit
    mode: FastestMode
    key: str
    carried: tuple[float, ...] | None

    @property
    def rate_hz(self) -> int | None:
        """The loop rate that would carry it; None if none does that a session may have."""
        rate_hz = ceil(self.mode.rate_per_s / ADVISED_RATIO)
        filtered = self.mode.rate_per_s * (self.limit.filter_s or 0.0)
        return rate_hz if rate_hz <= MOST_HZ and filtered <= ADVISED_FILTER_RATIO else None


@dataclass(frozen=True, slots=True)
class Remedy:
    """Changes that together certify the session, and what speaks against them."""

    means: Means
    changes: tuple[Change, ...]
    certification: Certification
    overloads: tuple[Overload, ...] = ()

    @property
    def cost(self) -> float:
        """The greatest relative change of any number."""
        return max(change.relative for change in self.changes)


def remedies(session: Session) -> tuple[Remedy, ...]:
    """Return the cheapest remedy by each means, those within the advised limits first.

    Every one has been certified with its numbers as they stand.
    """
    searches = {site: pose_search(session, site) for site in SiteId}
    families = (
        _more_damping(session, Means.TASK_DAMPING, searches),
        _more_damping(session, Means.JOINT_DAMPING, searches),
        list(_less_stiffness(session)),
        list(_shorter_round_trip(session)),
    )
    cheapest = (min(family, key=_order) for family in families if family)
    return tuple(sorted(cheapest, key=_order))


def changed(session: Session, changes: Iterable[Change]) -> Session:
    """Return the session with the changes made; its text and digest stay those of the file."""
    for change in changes:
        session = _with(session, change.key.split("."), change.new)
    return session


def _order(remedy: Remedy) -> tuple[bool, float, float]:
    # From nothing every change costs 1: then the smaller numbers.
    size = sum(float(np.sum(change.new)) for change in remedy.changes)
    return bool(remedy.overloads), remedy.cost, size


def _with(table: Any, steps: list[str], value: Value) -> Any:  # noqa: ANN401  any table of a session
    name, *rest = steps
    return replace(table, **{name: _with(getattr(table, name), rest, value) if rest else value})


def _remedy(session: Session, means: Means, new: Mapping[str, Value]) -> Remedy | None:
    """Return the remedy of these values; None if it changes nothing, or is not enough."""
    changes = []
    for key, value in new.items():
        old: Any = session
        for name in key.split("."):
            old = getattr(old, name)
        if old != value:
            changes.append(Change(key, old, value))
    certification = certify(changed(session, changes))
    if not changes or certification.margin_s <= 0.0:
        return None
    return Remedy(means, tuple(changes), certification)


# More damping: Theorem B along the task axes, Theorem A in the joints

_Pair = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One site's damping of one kind; its relaxation [s], (z,) or (1,), is in proportion to it."""

    means: Means
    site: SiteId
    settings: DampingSettings
    relaxation_s: FloatArray
    stiffness: FloatArray
    limit: DampingLimit
    search: PoseSearch

    @property
    def key(self) -> str:
        name = "task_n_s_per_m" if self.means is Means.TASK_DAMPING else "joint_nm_s"
        return f"{self.site.label}.damping.{name}"

    def numbers(self, relaxation_s: FloatArray) -> tuple[float, ...]:
        """Return the damping of this relaxation; what grows is rounded up."""
        if self.means is Means.TASK_DAMPING:
            old, new = self.settings.task_n_s_per_m, relaxation_s * self.stiffness
        else:
            old = self.settings.joint_nm_s
            new = np.array(old) * relaxation_s / self.relaxation_s
        return tuple(
            rounded_up(value) if value > given * _STRICTLY else given
            for given, value in zip(old, new.tolist(), strict=True)
        )

    def fastest(self, numbers: Iterable[float]) -> FastestMode:
        """Return the fastest mode with these numbers in place of this damping."""
        name = self.key.rpartition(".")[2]
        return self.search.fastest(damping_of(replace(self.settings, **{name: tuple(numbers)})))

    def carried_share(self, numbers: tuple[float, ...]) -> float:
        """Return the greatest share of the numbers, up to 1, within the limit; 0 if none is."""
        if self.fastest(numbers).rate_per_s <= self.limit.rate_per_s:
            return 1.0
        least, most = 0.0, 1.0
        while most - least > 2e-3 * most:
            middle = 0.5 * (least + most)
            rate = self.fastest(middle * number for number in numbers).rate_per_s
            least, most = (middle, most) if rate <= self.limit.rate_per_s else (least, middle)
            if most < 1e-3:
                return 0.0
        return least

    def overload(self, numbers: tuple[float, ...]) -> Overload | None:
        """Return what speaks against these numbers, if anything."""
        share, mode = self.carried_share(numbers), self.fastest(numbers)
        if share == 1.0:
            return None
        carried = tuple(rounded_down(share * number) for number in numbers) if share else None
        return Overload(self.limit, mode, self.key, carried)


def _more_damping(
    session: Session, means: Means, searches: Mapping[SiteId, PoseSearch]
) -> list[Remedy]:
    coupling = coupling_of(session.coupling)
    relaxation = relaxation_theorem_b if means is Means.TASK_DAMPING else relaxation_theorem_a
    local, remote = (
        _Side(
            means,
            site,
            session.site(site).damping,
            relaxation(coupling, site_gains(session, site)),
            coupling.stiffness,
            damping_limit(session, site),
            searches[site],
        )
        for site in SiteId
    )
    trip_s, hold_s = injected_round_trip_s(session) * _STRICTLY, hold_of(session)
    alike = _alike(local.relaxation_s, remote.relaxation_s, trip_s, hold_s)
    at_own = (local.relaxation_s, remote.relaxation_s)
    found = _certified(session, local, remote, [alike, *_one_pays(at_own, at_own, trip_s, hold_s)])
    if any(remedy.overloads for remedy in found):
        # One site to its limit, and the other pays the rest.
        limits = [
            np.maximum(side.relaxation_s, _ROUNDING * side.carried_share(side.numbers(x)) * x)
            for side, x in zip((local, remote), alike, strict=True)
        ]
        pairs = _one_pays(at_own, (limits[0], limits[1]), trip_s, hold_s)
        found += _certified(session, local, remote, pairs)
    return found


def _alike(local_s: FloatArray, remote_s: FloatArray, trip_s: float, hold_s: float) -> _Pair:
    """Return both relaxations raised by one factor, the least that certifies."""
    scale = np.maximum(required_scale(local_s, remote_s, trip_s, hold_s), 1.0)
    half_s = 0.5 * trip_s + hold_s  # what each site brings where no factor leads anywhere
    local, remote = (
        np.multiply(scale, x, where=np.isfinite(scale), out=np.maximum(x, half_s))
        for x in (local_s, remote_s)
    )
    return local, remote


def _one_pays(own: _Pair, given: _Pair, trip_s: float, hold_s: float) -> Iterator[_Pair]:
    """Yield pairs of one site's given relaxation, and what the other then needs."""
    for payer in (0, 1):
        needed = required_relaxation(given[1 - payer], trip_s, hold_s)
        paid = np.maximum(own[payer], needed)
        yield (paid, given[1]) if payer == 0 else (given[0], paid)


def _certified(
    session: Session, local: _Side, remote: _Side, pairs: Iterable[_Pair]
) -> list[Remedy]:
    found = []
    for pair in pairs:
        if not all(np.isfinite(side_s).all() for side_s in pair):
            continue
        new = {
            side.key: side.numbers(side_s)
            for side, side_s in zip((local, remote), pair, strict=True)
        }
        remedy = _remedy(session, local.means, new)
        if remedy is not None:
            keys = {change.key for change in remedy.changes}
            overloads = (
                side.overload(new[side.key]) for side in (local, remote) if side.key in keys
            )
            found.append(replace(remedy, overloads=tuple(filter(None, overloads))))
    return found


# Less stiffness


def _less_stiffness(session: Session) -> Iterator[Remedy]:
    settings, coupling = session.coupling, coupling_of(session.coupling)
    if isinstance(settings, PaperCoupling):
        key, old = "coupling.omega", settings.omega
    else:
        key, old = "coupling.stiffness_n_per_m", settings.stiffness_n_per_m
    trip_s, hold_s = injected_round_trip_s(session) * _STRICTLY, hold_of(session)
    local, remote = (site_gains(session, site) for site in SiteId)
    scale_b, scale_a = (
        required_scale(relaxation(coupling, local), relaxation(coupling, remote), trip_s, hold_s)
        for relaxation in (relaxation_theorem_b, relaxation_theorem_a)
    )
    stiffness = coupling.stiffness
    # Theorem B asks it along every axis, Theorem A of the stiffest.
    for most in (stiffness / scale_b, stiffness.max() / scale_a):
        share = np.minimum(most / stiffness, 1.0)
        if (share > 0.0).all():
            new = tuple(
                given if part == 1.0 else rounded_down(part * given)
                for given, part in zip(old, share.tolist(), strict=True)
            )
            remedy = _remedy(session, Means.STIFFNESS, {key: new})
            if remedy is not None:
                yield remedy


# A shorter round trip

# The smaller first: lowered in this order, none is ever above the one that bounds it.
_DELAY_TIMES: Mapping[type, tuple[str, ...]] = {
    ConstantDelay: ("delay_s",),
    SinusoidDelay: ("amplitude_s", "mean_s"),
    UniformDelay: ("low_s", "high_s"),
}


def _shorter_round_trip(session: Session) -> Iterator[Remedy]:
    channel = session.channel
    certified_s = certify(session).best.round_trip_s / _STRICTLY
    over_s = injected_round_trip_s(session) - certified_s
    times = dict(_delay_times(session))
    shortened_s = sum(
        direction.bound_s
        for direction in (channel.local_to_remote, channel.remote_to_local)
        if type(direction.delay) in _DELAY_TIMES
    )
    if times and over_s < shortened_s:
        share = 1.0 - over_s / shortened_s
        new = {key: rounded_down(share * value) for key, value in times.items()}
        remedy = _remedy(session, Means.ROUND_TRIP, new)
        if remedy is not None:
            yield remedy
    rate_hz, send_rate_hz = session.loop.rate_hz, channel.send_rate_hz or session.loop.rate_hz
    for faster_hz in range(send_rate_hz + 1, rate_hz + 1):
        if rate_hz % faster_hz == 0:
            remedy = _remedy(session, Means.ROUND_TRIP, {"channel.send_rate_hz": faster_hz})
            if remedy is not None:
                yield remedy
                return


def _delay_times(session: Session) -> Iterator[tuple[str, float]]:
    """Yield the keys that set how long packets take, each in proportion to its bound."""
    for name in DIRECTIONS:
        direction = getattr(session.channel, name)
        names = _DELAY_TIMES.get(type(direction.delay), ())
        for time in names:
            yield f"channel.{name}.delay.{time}", getattr(direction.delay, time)
        if names and direction.reordering is not None:
            yield f"channel.{name}.reordering.extra_s", direction.reordering.extra_s
