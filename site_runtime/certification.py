"""Which round trip a session's gains are proven for, and what its loop rate can carry."""

from dataclasses import dataclass

import numpy as np

from control_law import sampling
from control_law.certificates import (
    Certificate,
    SiteGains,
    best,
    paper_condition,
    theorem_a,
    theorem_b,
)
from hardware.robot_model import RobotModel
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of, robot_of
from site_runtime.session import Session

POSES = 2000


@dataclass(frozen=True, slots=True)
class SamplingRatio:
    """The worst a = T_s·λ_max(M⁻¹Λ) found over sampled poses of one robot, and where [rad]."""

    site: SiteId
    ratio: float
    pose_rad: tuple[float, ...]

    @property
    def advised(self) -> bool:
        """Whether the ratio is within the advised one."""
        return self.ratio <= sampling.ADVISED_RATIO

    @property
    def stable(self) -> bool:
        """Whether the loop is stable even one tick late with differenced velocity."""
        return self.ratio < sampling.LIMIT_LATE_DIFFERENCE


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


def certify(session: Session) -> Certification:
    """Certify a session's gains by each theorem."""
    coupling = coupling_of(session.coupling)
    local, remote = (
        SiteGains(damping_of(session.site(site).damping), robot_of(session, site).reach_m)
        for site in (SiteId.LOCAL, SiteId.REMOTE)
    )
    hold_s = session.period_ns * 1e-9
    rules = (paper_condition, theorem_a, theorem_b)
    channel = session.channel
    injected_s = 2.0 * (session.send_period_ns + session.period_ns) * 1e-9
    if channel.injection != "off":
        injected_s += channel.local_to_remote.bound_s + channel.remote_to_local.bound_s
    return Certification(
        tuple(rule(coupling, local, remote, hold_s) for rule in rules),
        best(coupling, local, remote, hold_s),
        injected_s,
    )


def sampling_ratio(session: Session, site: SiteId) -> SamplingRatio:
    """Search the pose where damping weighs most against inertia, by seeded random poses."""
    robot = robot_of(session, site)
    damping = damping_of(session.site(site).damping)
    rng = np.random.default_rng(session.seed)
    worst, where = 0.0, np.zeros(robot.joints)
    for pose in _poses(robot, rng):
        terms = robot.terms(pose, np.zeros(robot.joints))
        ratio = sampling.damping_ratio(session.period_ns * 1e-9, terms.M, damping.matrix(terms.J))
        if ratio > worst:
            worst, where = ratio, pose
    return SamplingRatio(site, worst, tuple(where.tolist()))


def _poses(robot: RobotModel, rng: np.random.Generator) -> np.ndarray:
    lower, upper = (
        np.where(np.isfinite(limit), limit, side * np.pi)
        for limit, side in zip(robot.position_limits_rad, (-1.0, 1.0), strict=True)
    )
    return rng.uniform(lower, upper, (POSES, robot.joints))
