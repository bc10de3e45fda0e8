"""The energy of a running session, from its rows: of the proof, put in, and dissipated."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from control_law.certificates import (
    Theorem,
    relaxation_theorem_a,
    relaxation_theorem_b,
    round_trip,
)
from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.lyapunov import LyapunovKrasovskii, SiteMotion
from hardware.robot_model import RobotModel, RobotTerms
from site_runtime.certification import certify, hold_of, site_gains, slowest_send_period_ns
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of, robot_of
from site_runtime.session import Session
from site_runtime.supervisor import STOPPED, State
from telemetry.energy import EnergyTrace
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

Reference = Callable[[RobotTerms, float], FloatArray]
"""ζ (n,) of (4) at a robot's terms, so long after engagement [s]."""

PERIOD_NS: Final = 10_000_000
GAP_NS: Final = 100_000_000
"""What happened between two rows further apart is not known, and not counted."""


@dataclass(frozen=True, slots=True)
class FunctionalRules:
    """What V is made of: the windows d̄_l, d̄_r [s] and α = 1/γ of its transit energy."""

    window_local_s: float
    window_remote_s: float
    alpha: float

    def functional(self, coupling: Coupling) -> LyapunovKrasovskii:
        """Begin a V whose past is at rest."""
        windows_s = self.window_local_s, self.window_remote_s
        return LyapunovKrasovskii(coupling, *windows_s, self.alpha, 1.0 / self.alpha)


class SessionEnergyMeter:
    """Work by every row; s = q̇ − ζ, M and V a hundred times a second, ζ in between by a line.

    V is NaN but where both sites are ENGAGED with their whole gains: the proof is about those.
    """

    def __init__(
        self,
        coupling: Coupling,
        rules: FunctionalRules,
        robots: tuple[RobotModel, RobotModel],
        dampings: tuple[Damping, Damping],
        reference: Reference | None,
    ) -> None:
        self._coupling = coupling
        self._rules = rules
        self._functional = rules.functional(coupling)
        self._sites = (
            _SiteMeter(robots[0], dampings[0], None),
            _SiteMeter(robots[1], dampings[1], reference),
        )
        self._work_j = np.zeros((2, 2))
        self._last: tuple[int, FloatArray] | None = None
        self._measured_ns: int | None = None

    def update(self, times_ns: IntArray, local: RowArray, remote: RowArray) -> EnergyTrace:
        """Take the rows (k,) of both sites at these times (k,) [ns], one clock, rising."""
        if not len(times_ns):
            return EnergyTrace(times_ns, *(np.empty((0, columns)) for columns in (3, 2, 2)))
        due = self._due(times_ns)
        measured = [
            site.measure(times_ns, rows, due)
            for site, rows in zip(self._sites, (local, remote), strict=True)
        ]
        work_j = self._integrate(times_ns, np.stack([powers_w for powers_w, _ in measured], axis=1))
        functional_j = np.full((len(due), 3), np.nan)
        for i, (tick, at_local, at_remote) in enumerate(
            zip(due.tolist(), measured[0][1], measured[1][1], strict=True)
        ):
            energy_j = self._functional_at(
                int(times_ns[tick]),
                at_local,
                at_remote,
                _told_m(local, tick) - _told_m(remote, tick),
            )
            if _whole(local, tick) and _whole(remote, tick):
                functional_j[i] = energy_j
        return EnergyTrace(times_ns[due], functional_j, work_j[due, :, 0], work_j[due, :, 1])

    def _due(self, times_ns: IntArray) -> npt.NDArray[np.intp]:
        """Return the first row of each period of the clock."""
        periods = times_ns // PERIOD_NS
        before = -1 if self._measured_ns is None else self._measured_ns // PERIOD_NS
        return np.flatnonzero(np.diff(periods, prepend=before))

    def _integrate(self, times_ns: IntArray, powers_w: FloatArray) -> FloatArray:
        """Return the work (k, 2, 2) [J] so far, by the trapezoidal rule."""
        last_ns, last_w = self._last or (int(times_ns[0]), powers_w[0])
        steps_s = np.diff(times_ns, prepend=last_ns) * 1e-9
        before_w = np.concatenate((last_w[None], powers_w[:-1]))
        added_j = 0.5 * steps_s[:, None, None] * (before_w + powers_w)
        added_j[steps_s > GAP_NS * 1e-9] = 0.0
        work_j: FloatArray = self._work_j + np.cumsum(added_j, axis=0)
        self._work_j = work_j[-1]
        self._last = int(times_ns[-1]), powers_w[-1]
        return work_j

    def _functional_at(
        self, now_ns: int, local: SiteMotion, remote: SiteMotion, error_m: FloatArray
    ) -> tuple[float, float, float]:
        before_ns, self._measured_ns = self._measured_ns, now_ns
        if before_ns is None or now_ns - before_ns > GAP_NS:
            self._functional = self._rules.functional(self._coupling)
            before_ns = now_ns
        energy = self._functional.update(local, remote, error_m, (now_ns - before_ns) * 1e-9)
        return energy.kinetic, energy.coupling, energy.transit


class _SiteMeter:
    """One site's powers and motion along its rows."""

    def __init__(self, robot: RobotModel, damping: Damping, reference: Reference | None) -> None:
        self._robot = robot
        self._damping = damping
        self._reference = reference
        self._zeta: tuple[int, FloatArray] | None = None

    def measure(
        self, times_ns: IntArray, rows: RowArray, due: npt.NDArray[np.intp]
    ) -> tuple[FloatArray, list[SiteMotion]]:
        """Return F·Ẋ and sᵀΛs (k, 2) [W] of all rows, and s, M, Ẋ of those that are due.

        As Λ = diag(joint) + Jᵀ diag(task) J and Js = Ẋ, the powers need no Jacobian.
        """
        # a time since engagement is told of the ticks that command a torque
        driven = np.isfinite(rows["engaged_s"])
        motions: list[SiteMotion] = []
        zetas = [] if self._zeta is None else [self._zeta]
        for tick in due.tolist():
            terms = self._robot.terms(rows["q"][tick], rows["q_dot"][tick])
            zeta = np.zeros_like(terms.q_dot)
            if self._reference is not None and driven[tick]:
                zeta = self._reference(terms, float(rows["engaged_s"][tick]))
            motions.append(SiteMotion(terms.q_dot - zeta, terms.M, rows["velocity_m_s"][tick]))
            zetas.append((int(times_ns[tick]), zeta))
        s = np.array(rows["q_dot"], np.float64)
        if self._reference is not None and zetas:
            self._zeta = zetas[-1]
            at_ns, at = [at_ns for at_ns, _ in zetas], np.array([zeta for _, zeta in zetas])
            for joint in range(s.shape[1]):
                s[:, joint] -= np.interp(times_ns, at_ns, at[:, joint])
        X_dot = rows["velocity_m_s"]
        # A stopped site repeats its last row: what moves in there moves no more.
        alive = ~np.isin(rows["state"], list(STOPPED))
        injected_w = np.einsum("kz,kz->k", rows["external_force_n"], X_dot)
        dissipated_w = np.square(s) @ self._damping.joint + np.square(X_dot) @ self._damping.task
        return np.column_stack((alive * injected_w, driven * dissipated_w)), motions


def energy_meter(session: Session, reference: Reference | None) -> SessionEnergyMeter:
    """Return the meter of a session; `reference` is the remote controller's ζ, None without one."""
    return SessionEnergyMeter(
        coupling_of(session.coupling),
        functional_rules(session),
        (robot_of(session, SiteId.LOCAL), robot_of(session, SiteId.REMOTE)),
        (damping_of(session.local.damping), damping_of(session.remote.damping)),
        reference,
    )


def functional_rules(session: Session) -> FunctionalRules:
    """Return the V that falls wherever the best certificate holds, as far as one V can tell.

    The windows are each direction's bound of injected delay, packet spacing and a tick, and half
    of the certified margin each; α = √(x_l/x_r) of the certificate's relaxations x, on the axis
    that limits it.
    """
    certification = certify(session)
    spare_s = max(certification.margin_s, 0.0) / 2.0
    spare_s += (slowest_send_period_ns(session) + session.period_ns) * 1e-9
    channel = session.channel
    windows_s = [spare_s, spare_s]
    if channel.injection != "off":
        windows_s[0] += channel.local_to_remote.bound_s
        windows_s[1] += channel.remote_to_local.bound_s
    coupling, hold_s = coupling_of(session.coupling), hold_of(session)
    gains = [site_gains(session, site) for site in SiteId]
    relaxation = (
        relaxation_theorem_b if certification.best.theorem is Theorem.B else relaxation_theorem_a
    )
    local_s, remote_s = (relaxation(coupling, site) for site in gains)
    axis = int(round_trip(local_s, remote_s, hold_s).argmin())
    spare = np.maximum([local_s[axis] - hold_s, remote_s[axis] - hold_s], 0.0)
    alpha = float(np.sqrt(spare[0] / spare[1])) if spare.all() else 1.0
    return FunctionalRules(windows_s[0], windows_s[1], alpha)


def _told_m(rows: RowArray, tick: int) -> FloatArray:
    told_m: FloatArray = rows["position_m"][tick] - rows["offset_m"][tick]
    return told_m


def _whole(rows: RowArray, tick: int) -> bool:
    return bool(rows["state"][tick] == State.ENGAGED and rows["force_share"][tick] == 1.0)
