"""Which round trip the gains tolerate: three sufficient conditions, from strict to sharp.

In all of them T = d̄_l + d̄_r, each d̄ the greatest age of the peer sample in use, so that
sample-and-hold, loss and reordering are counted in; K_j = Ω_j p_j′(0); and the conclusion is the
paper's Theorems 1 and 2. The paper's own proof of (17) has a gap at (14), but (17) implies
`theorem_a` with a factor of at least four to spare, so it stays a correct sufficient condition.

A hold h̄ of each site's own position (its age when the torque acts) costs 2h̄ of round trip when the
two sites are equally damped. Proofs: docs/theory.md.

Theorems A and B are one condition, (x_l − h̄)(x_r − h̄) > (T/2)², on a time x at each site: the
`relaxation` of its damping against the stiffness, 1/μ in Theorem A and D_j/K_j in Theorem B.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from control_law.coupling import Coupling
from control_law.damping import Damping

FloatArray = npt.NDArray[np.float64]

_SITES = ("local", "remote")


@dataclass(frozen=True, slots=True, eq=False)
class SiteGains:
    """What a certificate needs of one site.

    `reach_m` (n,): an upper bound, over all poses, of the distance of the end effector from each
    joint's axis centre.
    """

    damping: Damping
    reach_m: FloatArray

    def __post_init__(self) -> None:
        if self.reach_m.shape != self.damping.joint.shape:
            raise ValueError(
                f"reach {self.reach_m.shape} and joint damping {self.damping.joint.shape} "
                "must have one entry per joint"
            )
        if not (np.isfinite(self.reach_m).all() and (self.reach_m > 0).all()):
            raise ValueError(f"reach {self.reach_m} m must be positive and finite")

    @property
    def joints(self) -> int:
        """β_k, the number of joints."""
        return len(self.reach_m)


class Theorem(StrEnum):
    """Which sufficient condition a certificate rests on."""

    PAPER = "paper (17)"
    A = "Theorem A"
    B = "Theorem B"


@dataclass(frozen=True, slots=True)
class Certificate:
    """The round trip [s] below which a theorem guarantees stability; 0 certifies nothing."""

    theorem: Theorem
    round_trip_s: float
    reason: str


def paper_condition(
    coupling: Coupling, local: SiteGains, remote: SiteGains, hold_s: float = 0.0
) -> Certificate:
    """Certify by (17), Λ_min ≥ 2TΩ_max β J_max², with J_max² the square of the reach.

    Uses the joint damping alone, and the weaker site decides.
    """
    trips = [
        float(site.damping.joint.min()) / required_joint_damping_paper(1.0, coupling, site.reach_m)
        - 2.0 * hold_s
        for site in (local, remote)
    ]
    weaker = _SITES[int(np.argmin(trips))]
    if min(trips) <= 0.0:
        return Certificate(Theorem.PAPER, 0.0, _used_up(hold_s, f"{weaker} joint damping"))
    return Certificate(Theorem.PAPER, min(trips), f"limited by the {weaker} joint damping")


def theorem_a(
    coupling: Coupling, local: SiteGains, remote: SiteGains, hold_s: float = 0.0
) -> Certificate:
    """Certify by T√(μ_l μ_r) < 2, μ = sup λ_max(Λ^−½ JᵀKJ Λ^−½).

    Uses the joint damping alone, through μ ≤ max_j K_j · Σ_i reach_i²/λ_i, which a planar arm
    attains when straight, across the stiffest axis. One site's damping pays for the other's.
    """
    local_s, remote_s = (relaxation_theorem_a(coupling, site) for site in (local, remote))
    trip_s = float(round_trip(local_s, remote_s, hold_s)[0])
    if trip_s == 0.0:
        weaker = _SITES[int(np.argmin([local_s, remote_s]))]
        return Certificate(Theorem.A, 0.0, _used_up(hold_s, f"{weaker} joint damping"))
    return Certificate(Theorem.A, trip_s, "limited by the joint damping of both sites")


def theorem_b(
    coupling: Coupling, local: SiteGains, remote: SiteGains, hold_s: float = 0.0
) -> Certificate:
    """Certify by D_lj D_rj ≥ (T/2)² K_j² on every task axis.

    Uses the task damping D alone: no arm geometry enters. The joint damping must be positive,
    as `Damping` ensures, and adds nothing to T.
    """
    local_s, remote_s = (relaxation_theorem_b(coupling, site) for site in (local, remote))
    trips_s = round_trip(local_s, remote_s, hold_s)
    axis = int(trips_s.argmin())
    if trips_s[axis] > 0.0:
        reason = f"limited by the task damping of both sites along axis {axis}"
        return Certificate(Theorem.B, float(trips_s[axis]), reason)
    along = (local_s[axis], remote_s[axis])
    without = [site for site, x in zip(_SITES, along, strict=True) if x == 0.0]
    if without:
        sites = " and the ".join(without)
        reason = f"there is no task damping along axis {axis} at the {sites} site"
        return Certificate(Theorem.B, 0.0, reason)
    weaker = _SITES[int(np.argmin(along))]
    return Certificate(Theorem.B, 0.0, _used_up(hold_s, f"{weaker} task damping along axis {axis}"))


def best(
    coupling: Coupling, local: SiteGains, remote: SiteGains, hold_s: float = 0.0
) -> Certificate:
    """Return the certificate of the three that tolerates the longest round trip."""
    return max(
        (rule(coupling, local, remote, hold_s) for rule in (theorem_b, theorem_a, paper_condition)),
        key=lambda certificate: certificate.round_trip_s,
    )


def required_joint_damping_paper(
    round_trip_s: float, coupling: Coupling, reach_m: FloatArray, hold_s: float = 0.0
) -> float:
    """Return the smallest joint damping [N·m·s/rad] that (17) allows at this site."""
    reach = float(reach_m.max())
    return (
        2.0 * (round_trip_s + 2.0 * hold_s) * float(coupling.omega.max()) * len(reach_m) * reach**2
    )


def required_joint_damping_theorem_a(
    round_trip_s: float, coupling: Coupling, reach_m: FloatArray, hold_s: float = 0.0
) -> float:
    """Return the joint damping, the same in every joint, that Theorem A asks of each site alone.

    (T/2 + h̄) μ at unit damping, [N·m·s/rad]: the symmetric form; any more is strict.
    """
    return (0.5 * round_trip_s + hold_s) * _spectral_bound(coupling, np.ones_like(reach_m), reach_m)


def required_task_damping_theorem_b(
    round_trip_s: float, coupling: Coupling, hold_s: float = 0.0
) -> FloatArray:
    """Return the task damping D = (T/2 + h̄)K [N·s/m], (z,), that Theorem B asks of each site."""
    return (0.5 * round_trip_s + hold_s) * coupling.stiffness


def relaxation_theorem_a(coupling: Coupling, site: SiteGains) -> FloatArray:
    """Return 1/μ [s], (1,): how long the joint damping holds the stiffest pull back."""
    return np.array([1.0 / _spectral_bound(coupling, site.damping.joint, site.reach_m)])


def relaxation_theorem_b(coupling: Coupling, site: SiteGains) -> FloatArray:
    """Return D/K [s], (z,)."""
    relaxation: FloatArray = site.damping.task / coupling.stiffness
    return relaxation


def round_trip(local_s: FloatArray, remote_s: FloatArray, hold_s: float) -> FloatArray:
    """Return the T [s] at the edge, for each entry of both relaxations; 0 if there is none."""
    spare_l, spare_r = (np.maximum(side - hold_s, 0.0) for side in (local_s, remote_s))
    trip: FloatArray = 2.0 * np.sqrt(spare_l * spare_r)
    return trip


def required_scale(
    local_s: FloatArray, remote_s: FloatArray, round_trip_s: float, hold_s: float
) -> FloatArray:
    """Return the factor that brings both relaxations to the edge, for each entry; inf from zero.

    Both sites' damping may grow by it, or the stiffness shrink by it.
    """
    # (g x_l − h)(g x_r − h) = (T/2)², where both brackets are positive
    total, product = local_s + remote_s, local_s * remote_s
    root = np.sqrt((hold_s * (local_s - remote_s)) ** 2 + product * round_trip_s**2)
    scale = np.full(product.shape, np.inf)
    np.divide(0.5 * (hold_s * total + root), product, out=scale, where=product > 0.0)
    return scale


def required_relaxation(peer_s: FloatArray, round_trip_s: float, hold_s: float) -> FloatArray:
    """Return the relaxation [s] that one site needs beside the other's; inf if none is enough."""
    spare = np.maximum(peer_s - hold_s, 0.0)
    with np.errstate(divide="ignore"):
        needed: FloatArray = hold_s + (0.5 * round_trip_s) ** 2 / spare
    return needed


def _spectral_bound(coupling: Coupling, joint_damping: FloatArray, reach_m: FloatArray) -> float:
    """Return an upper bound of μ [1/s]: tr(JΛ⁻¹Jᵀ) with each column at its longest."""
    return float(coupling.stiffness.max() * np.sum(np.square(reach_m) / joint_damping))


def _used_up(hold_s: float, damping: str) -> str:
    return f"the hold of {hold_s * 1e3:g} ms alone uses up the {damping}"
