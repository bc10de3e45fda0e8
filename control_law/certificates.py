"""Which round trip the gains tolerate: three sufficient conditions, from strict to sharp.

In all of them T = d̄_l + d̄_r, each d̄ the greatest age of the peer sample in use, so that
sample-and-hold, loss and reordering are counted in; K_j = Ω_j p_j′(0); and the conclusion is the
paper's Theorems 1 and 2. The paper's own proof of (17) has a gap at (14), but (17) implies
`theorem_a` with a factor of at least four to spare, so it stays a correct sufficient condition.

A hold h̄ of each site's own position (its age when the torque acts) costs 2h̄ of round trip when the
two sites are equally damped. Proofs: docs/theory.md.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt

from control_law.coupling import Coupling
from control_law.damping import Damping

FloatArray = npt.NDArray[np.float64]


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


@dataclass(frozen=True, slots=True)
class Certificate:
    """The round trip [s] below which a theorem guarantees stability; 0 certifies nothing."""

    theorem: str
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
    weaker = "local" if trips[0] < trips[1] else "remote"
    return _certificate("paper (17)", min(trips), f"limited by the {weaker} joint damping", hold_s)


def theorem_a(
    coupling: Coupling, local: SiteGains, remote: SiteGains, hold_s: float = 0.0
) -> Certificate:
    """Certify by T√(μ_l μ_r) < 2, μ = sup λ_max(Λ^−½ JᵀKJ Λ^−½).

    Uses the joint damping alone, through μ ≤ max_j K_j · Σ_i reach_i²/λ_i, which a planar arm
    attains when straight, across the stiffest axis. One site's damping pays for the other's. With
    a hold the condition is (T/2)² < (1/μ_l − h̄)(1/μ_r − h̄).
    """
    spare_l, spare_r = (
        1.0 / _spectral_bound(coupling, site.damping.joint, site.reach_m) - hold_s
        for site in (local, remote)
    )
    trip = 2.0 * sqrt(max(spare_l, 0.0) * max(spare_r, 0.0))
    return _certificate("Theorem A", trip, "limited by the joint damping of both sites", hold_s)


def theorem_b(
    coupling: Coupling, local: SiteGains, remote: SiteGains, hold_s: float = 0.0
) -> Certificate:
    """Certify by D_lj D_rj ≥ (T/2)² K_j² on every task axis.

    Uses the task damping D alone: no arm geometry enters. The joint damping must be positive,
    as `Damping` ensures, and adds nothing to T. With a hold: (D_l − h̄K)(D_r − h̄K) ≥ (T/2)² K².
    """
    stiffness = coupling.stiffness
    spare_l, spare_r = (
        np.maximum(site.damping.task / stiffness - hold_s, 0.0) for site in (local, remote)
    )
    trips = 2.0 * np.sqrt(spare_l * spare_r)
    axis = int(trips.argmin())
    reason = f"limited by the task damping of both sites along axis {axis}"
    return _certificate("Theorem B", float(trips[axis]), reason, hold_s)


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


def _spectral_bound(coupling: Coupling, joint_damping: FloatArray, reach_m: FloatArray) -> float:
    """Return an upper bound of μ [1/s]: tr(JΛ⁻¹Jᵀ) with each column at its longest."""
    return float(coupling.stiffness.max() * np.sum(np.square(reach_m) / joint_damping))


def _certificate(theorem: str, round_trip_s: float, reason: str, hold_s: float) -> Certificate:
    if round_trip_s > 0.0:
        return Certificate(theorem, round_trip_s, reason)
    if hold_s > 0.0:
        return Certificate(theorem, 0.0, f"{reason}: a hold of {hold_s} s leaves nothing")
    return Certificate(theorem, 0.0, f"{reason}: there is none")
