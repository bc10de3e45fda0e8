"""From a robot pair, a round trip and a stiffness to gains, certified, that the loops can carry.

The task damping is Theorem B's, D = margin·(T/2 + h)K at both sites; where one site's rate or
filter carries less, it takes what it carries and the other pays. The joint damping keeps the base
session's proportions between the joints. It is as large as adds a tenth of D to the drag at the
end effector, less where the advised limits leave less; where they leave less than a tenth of
that, there is no design.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import numpy.typing as npt

from control_law.certificates import required_relaxation, required_scale, round_trip
from control_law.damping import Damping
from site_runtime.certification import DampingLimit, damping_limit, hold_of, pose_search
from site_runtime.keys import SiteId
from site_runtime.pose_search import FastestMode, PoseSearch
from site_runtime.rounding import rounded_down, rounded_up
from site_runtime.session import DampingSettings, Session, SessionError, StiffnessCoupling
from site_runtime.session_edit import TomlValue
from site_runtime.session_settings import MOST_HZ

FloatArray = npt.NDArray[np.float64]

CEILING_DEPTH_M = 0.1
"""Where nothing else gives a force ceiling, it is the stiffness times this."""

_DRAG_SHARE = 0.1
_LEAST_DRAG_SHARE = 0.01
_WITHIN = 0.999  # of a limit: two searches over poses agree no better
_STATED = 1.0 - 1e-6  # of an edge


@dataclass(frozen=True, slots=True)
class Wish:
    """What the gains are to do.

    `margin` > 1 multiplies the damping that the round trip asks for. Without a `force_ceiling_n`
    the base session's is kept, or else the stiffness times `CEILING_DEPTH_M` taken.
    """

    round_trip_s: float
    stiffness_n_per_m: float
    margin: float = 1.2
    force_ceiling_n: float | None = None

    def __post_init__(self) -> None:
        for name, least in (
            ("round_trip_s", 0.0),
            ("stiffness_n_per_m", 0.0),
            ("margin", 1.0),
            ("force_ceiling_n", 0.0),
        ):
            value = getattr(self, name)
            if value is not None and not least < value < inf:
                raise SessionError(f"{name} = {value}: must be a number greater than {least:g}")

    def edge_s(self, hold_s: float) -> float:
        """Return the round trip [s] whose bare condition is this one's with the margin."""
        return self.margin * self.round_trip_s + 2.0 * (self.margin - 1.0) * hold_s

    def damping_n_s_per_m(self, hold_s: float) -> float:
        """Return margin·(T/2 + h)K, which both sites have where both can."""
        return self.margin * (0.5 * self.round_trip_s + hold_s) * self.stiffness_n_per_m


@dataclass(frozen=True, slots=True)
class Design:
    """Gains for a session."""

    coupling: StiffnessCoupling
    local: DampingSettings
    remote: DampingSettings

    def changes(self) -> Mapping[str, TomlValue]:
        """Return the session file's keys and their values."""
        coupling, found = self.coupling, dict[str, TomlValue]()
        found["coupling"] = {
            "law": coupling.law,
            "stiffness_n_per_m": coupling.stiffness_n_per_m,
            "force_ceiling_n": coupling.force_ceiling_n,
        }
        for site, damping in (("local", self.local), ("remote", self.remote)):
            found[f"{site}.damping.joint_nm_s"] = damping.joint_nm_s
            found[f"{site}.damping.task_n_s_per_m"] = damping.task_n_s_per_m
        return found


@dataclass(frozen=True, slots=True)
class Capacity:
    """The most task damping that one site carries beside the least joint damping.

    `mode` is that of 1 N·s/m; its pose is where the site carries least.
    """

    limit: DampingLimit
    mode: FastestMode

    @property
    def damping_n_s_per_m(self) -> float:
        """The most task damping, the same along every axis [N·s/m]."""
        return _WITHIN * self.limit.rate_per_s / self.mode.rate_per_s

    def at(self, rate_hz: int) -> "Capacity":
        """Return the capacity at another loop rate."""
        return replace(self, limit=replace(self.limit, period_s=round(1e9 / rate_hz) * 1e-9))


@dataclass(frozen=True, slots=True)
class NoDesign:
    """Why no gains exist, and what would, all else kept; None where nothing of the kind does."""

    wanted_n_s_per_m: float
    local: Capacity
    remote: Capacity
    stiffness_n_per_m: float
    round_trip_s: float | None
    rate_hz: int | None


def design(session: Session, wish: Wish) -> Design | NoDesign:
    """Return gains for the robots, rate and devices of a session, or why there are none."""
    local, remote = (_SiteDesign(session, site) for site in SiteId)
    hold_s = hold_of(session)
    pair = _task_damping(wish, local.capacity, remote.capacity, hold_s)
    if pair is None:
        return _no_design(session, wish, local.capacity, remote.capacity)
    z = session.task.dimension
    return Design(
        StiffnessCoupling("stiffness", (wish.stiffness_n_per_m,) * z, _ceiling(session, wish)),
        local.settings(pair[0]),
        remote.settings(pair[1]),
    )


class _SiteDesign:
    """One site: what it carries, and the joint damping beside a task damping."""

    def __init__(self, session: Session, site: SiteId) -> None:
        self._search: PoseSearch = pose_search(session, site)
        self._axes = np.ones(session.task.dimension)
        proportions = np.array(session.site(site).damping.joint_nm_s)
        self._joint = proportions / self._search.joint_drag(proportions)  # drags by 1 N·s/m
        self._limit = damping_limit(session, site)
        self.capacity = Capacity(self._limit, self._fastest(1.0, _LEAST_DRAG_SHARE))

    def settings(self, task_n_s_per_m: float) -> DampingSettings:
        """Return a task damping, and as much joint damping as serves and the limits leave."""
        share = self._drag_share(task_n_s_per_m)
        joint = (share * task_n_s_per_m * self._joint).tolist()
        return DampingSettings(
            tuple(rounded_down(value, 2) for value in joint),
            (task_n_s_per_m,) * len(self._axes),
        )

    def _drag_share(self, task_n_s_per_m: float) -> float:
        least, most = _LEAST_DRAG_SHARE, _DRAG_SHARE
        most_rate = _WITHIN * self._limit.rate_per_s
        if self._fastest(task_n_s_per_m, most).rate_per_s <= most_rate:
            return most
        for _ in range(10):
            middle = 0.5 * (least + most)
            within = self._fastest(task_n_s_per_m, middle).rate_per_s <= most_rate
            least, most = (middle, most) if within else (least, middle)
        return least

    def _fastest(self, task_n_s_per_m: float, drag_share: float) -> FastestMode:
        joint = drag_share * task_n_s_per_m * self._joint
        return self._search.fastest(Damping(joint, task_n_s_per_m * self._axes))


def _task_damping(
    wish: Wish, local: Capacity, remote: Capacity, hold_s: float
) -> tuple[float, float] | None:
    """Return both sites' task damping, alike if both carry it; None if they do not carry enough."""
    stiffness, edge_s = wish.stiffness_n_per_m, wish.edge_s(hold_s)
    wanted = wish.damping_n_s_per_m(hold_s)
    most = [local.damping_n_s_per_m, remote.damping_n_s_per_m]
    if wanted <= min(most):
        return _rounded_within(wanted, most[0]), _rounded_within(wanted, most[1])
    weaker, payer = (0, 1) if most[0] < most[1] else (1, 0)
    for digits in range(3, 9):
        damping = [0.0, 0.0]
        damping[weaker] = rounded_down(most[weaker], digits)
        relaxation_s = np.array([damping[weaker] / stiffness])
        needed = stiffness * float(required_relaxation(relaxation_s, edge_s, hold_s)[0])
        if needed <= most[payer]:
            damping[payer] = _rounded_within(max(needed, wanted), most[payer])
            return damping[0], damping[1]
    return None


def _rounded_within(value: float, most: float) -> float:
    """Return the value rounded up to as few digits, from three, as stay below the limit."""
    for digits in range(3, 9):
        rounded = rounded_up(value, digits)
        if rounded <= most:
            return rounded
    return float(value)


def _no_design(session: Session, wish: Wish, local: Capacity, remote: Capacity) -> NoDesign:
    hold_s = hold_of(session)
    most_l, most_r = (np.array([side.damping_n_s_per_m]) for side in (local, remote))
    stiffness = 1.0 / required_scale(most_l, most_r, wish.edge_s(hold_s), hold_s)[0]
    edge_s = round_trip(most_l / wish.stiffness_n_per_m, most_r / wish.stiffness_n_per_m, hold_s)[0]
    trip_s = (edge_s - 2.0 * (wish.margin - 1.0) * hold_s) / wish.margin
    return NoDesign(
        wish.damping_n_s_per_m(hold_s),
        local,
        remote,
        rounded_down(_STATED * float(stiffness)),
        rounded_down(_STATED * float(trip_s)) if trip_s > 0.0 else None,
        _enough_rate_hz(session, wish, local, remote),
    )


def _enough_rate_hz(session: Session, wish: Wish, local: Capacity, remote: Capacity) -> int | None:
    step_hz = session.channel.send_rate_hz or 1  # a site sends on every k-th tick

    def enough(steps: int) -> bool:
        rate_hz = steps * step_hz
        sides = local.at(rate_hz), remote.at(rate_hz)
        return _task_damping(wish, *sides, sides[0].limit.period_s) is not None

    least, most = session.loop.rate_hz // step_hz, MOST_HZ // step_hz
    if not enough(most):
        return None
    while most - least > 1:
        middle = (least + most) // 2
        least, most = (least, middle) if enough(middle) else (middle, most)
    return most * step_hz


def _ceiling(session: Session, wish: Wish) -> tuple[float, ...]:
    if wish.force_ceiling_n is not None:
        return (wish.force_ceiling_n,) * session.task.dimension
    if isinstance(session.coupling, StiffnessCoupling):
        return session.coupling.force_ceiling_n
    ceiling_n = rounded_down(CEILING_DEPTH_M * wish.stiffness_n_per_m)
    return (ceiling_n,) * session.task.dimension
