"""Which round trip a session's gains are proven for, and what its loop rate can carry."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

from control_law import sampling
from control_law.certificates import (
    Certificate,
    SiteGains,
    best,
    paper_condition,
    theorem_a,
    theorem_b,
)
from hardware.interface import VelocityByDifference
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of, robot_of
from site_runtime.pose_search import PoseSearch
from site_runtime.session import Session

SPACING_SHARE: Final = 0.25
"""Of the certified round trip that the spacing of both sites' packets may take when it adapts."""


@dataclass(frozen=True, slots=True)
class Certification:
    """The three certificates of a session, the best, and the round trip that it injects [s].

    A hold of one period is in every certificate: a torque acts on a position one tick old.
    `injected_round_trip_s` is the sum of both directions' bounds, packet spacing and a tick a side.
    """

    certificates: tuple[Certificate, ...]
    best: Certificate
    injected_round_trip_s: float

    @property
    def margin_s(self) -> float:
        """Certified minus injected round trip [s]."""
        return self.best.round_trip_s - self.injected_round_trip_s


class Bound(Enum):
    """What bounds the fastest damped mode of a site."""

    SAMPLING = "sampling"
    FILTER = "filter"


@dataclass(frozen=True, slots=True)
class DampingLimit:
    """How fast a damped mode λ_max(M⁻¹Λ) one site carries as advised.

    `filter_s` is the time constant of the filter on differenced velocities, None if velocity is
    exact.
    """

    site: SiteId
    period_s: float
    filter_s: float | None

    @property
    def rate_per_s(self) -> float:
        """The fastest mode within both bounds [1/s]."""
        return min(sampling.ADVISED_RATIO / self.period_s, self._filter_rate_per_s)

    @property
    def bound(self) -> Bound:
        """Which of the two is the tighter."""
        sampled = sampling.ADVISED_RATIO / self.period_s <= self._filter_rate_per_s
        return Bound.SAMPLING if sampled else Bound.FILTER

    @property
    def _filter_rate_per_s(self) -> float:
        return sampling.ADVISED_FILTER_RATIO / self.filter_s if self.filter_s else float("inf")


@dataclass(frozen=True, slots=True)
class SamplingRatio:
    """The worst a = T_s·λ_max(M⁻¹Λ) that a search over one robot's poses found, and where [rad].

    `filter_ratio` is λ_max·τ_f, None without a filter on differenced velocities.
    """

    site: SiteId
    ratio: float
    pose_rad: tuple[float, ...]
    filter_ratio: float | None = None

    @property
    def advised(self) -> bool:
        """Whether the ratios are within the advised ones."""
        filtered = self.filter_ratio is None or self.filter_ratio <= sampling.ADVISED_FILTER_RATIO
        return self.ratio <= sampling.ADVISED_RATIO and filtered

    @property
    def stable(self) -> bool:
        """Whether the loop is stable even one tick late with differenced velocity."""
        return self.ratio < sampling.LIMIT_LATE_DIFFERENCE


def certify(session: Session) -> Certification:
    """Certify a session's gains by each theorem."""
    coupling = coupling_of(session.coupling)
    local, remote = (site_gains(session, site) for site in SiteId)
    hold_s = hold_of(session)
    rules = (paper_condition, theorem_a, theorem_b)
    return Certification(
        tuple(rule(coupling, local, remote, hold_s) for rule in rules),
        best(coupling, local, remote, hold_s),
        injected_round_trip_s(session),
    )


def hold_of(session: Session) -> float:
    """Return the age of a site's own position when the torque acts [s]."""
    return session.period_ns * 1e-9


def site_gains(session: Session, site: SiteId) -> SiteGains:
    """Return what a certificate needs of one site."""
    damping = damping_of(session.site(site).damping)
    return SiteGains(damping, robot_of(session, site).reach_m)


def certified_round_trip_s(session: Session) -> float:
    """Return the longest round trip that the gains are proven for, by Theorems A and B [s]."""
    local, remote = (site_gains(session, site) for site in SiteId)
    return best(coupling_of(session.coupling), local, remote, hold_of(session)).round_trip_s


def slowest_send_period_ns(session: Session) -> int:
    """Return the time between two packets beyond which adapting never goes [ns], whole ticks.

    The spacing of both sites is part of the round trip: together they take a quarter of what is
    certified at most. And a third of the silence that leads to HOLD, as the session check asks.
    """
    if not session.channel.adapt_send_rate:
        return session.send_period_ns
    most_s = min(
        certified_round_trip_s(session) * SPACING_SHARE / 2.0,
        session.engagement.hold_after_s / 3.0,
    )
    ticks = int(most_s * 1e9) // session.period_ns
    return max(session.send_period_ns, ticks * session.period_ns)


def injected_round_trip_s(session: Session) -> float:
    """Return both directions' bounds, packet spacing at its slowest and a tick a side [s]."""
    channel = session.channel
    injected_s = 2.0 * (slowest_send_period_ns(session) + session.period_ns) * 1e-9
    if channel.injection != "off":
        injected_s += channel.local_to_remote.bound_s + channel.remote_to_local.bound_s
    return injected_s


def damping_limit(session: Session, site: SiteId) -> DampingLimit:
    """Return what one site's rate and velocity filter carry."""
    device = session.site(site).device
    filter_s = device.difference_filter_s if isinstance(device, VelocityByDifference) else None
    return DampingLimit(site, session.period_ns * 1e-9, filter_s)


def pose_search(session: Session, site: SiteId) -> PoseSearch:
    """Return the search over one robot's poses that every figure of a session rests on."""
    return PoseSearch(robot_of(session, site), session.seed)


def sampling_ratio(session: Session, site: SiteId) -> SamplingRatio:
    """Search the pose where damping weighs most against inertia."""
    mode = pose_search(session, site).fastest(damping_of(session.site(site).damping))
    limit = damping_limit(session, site)
    filtered = None if limit.filter_s is None else limit.filter_s * mode.rate_per_s
    return SamplingRatio(site, limit.period_s * mode.rate_per_s, mode.pose_rad, filtered)
