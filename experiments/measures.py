"""Figures that the paper and its studies read off a run, from every tick of it."""

from collections.abc import Callable, Iterator
from math import nan
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from control_law.lyapunov import LyapunovKrasovskii, SiteMotion
from experiments.simulation import Run
from hardware.robot_model import RobotTerms
from remote_site.site import build_remote_controller
from site_runtime.derived import derivation
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, robot_of
from site_runtime.session import Session
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
Measures: TypeAlias = dict[str, float]

_END_S = 0.5
_POSES_MEASURED = 4000
_NULL_SPACE = (
    "null_space_speed_start_rad_s",
    "null_space_speed_max_rad_s",
    "null_space_leak_m_s",
)


def settling_time_s(time_s: FloatArray, error_m: FloatArray, limit_m: float) -> float | None:
    """Return when the error last came below the limit for good [s]; None if it never did.

    An unknown error, NaN, is not below.
    """
    above = np.flatnonzero(~(error_m <= limit_m))
    if above.size == 0:
        return float(time_s[0])
    first_below = above[-1] + 1
    return float(time_s[first_below]) if first_below < len(time_s) else None


def measure(session: Session, run: Run, energy_j: FloatArray) -> Measures:
    """Return the figures of a run by name, with the unit in it; NaN where there is none.

    `end` is the mean of the last half second; `energy_j` is V at every tick, or empty.
    """
    if not len(run.local):
        return {}
    time_s = run.local["time_ns"] * 1e-9
    error_m = np.linalg.norm(run.local["position_m"] - run.remote["position_m"], axis=1)
    quarter = max(1, len(error_m) // 4)
    end = slice(-min(len(time_s), round(_END_S * session.loop.rate_hz)), None)
    derive = derivation(session)
    pairs = (("local", run.local), ("remote", run.remote))
    derived = {site: derive(site, rows["q"]) for site, rows in pairs}
    forces_n = (run.local["external_force_n"] + run.remote["external_force_n"])[end].mean(axis=0)
    figures: Measures = {
        "duration_s": float(time_s[-1]),
        "error_start_m": float(error_m[0]),
        "error_end_m": float(error_m[end].mean()),
        "error_max_m": float(error_m.max()),
        "error_second_quarter_m": float(error_m[quarter : 2 * quarter].max(initial=0.0)),
        "error_last_quarter_m": float(error_m[-quarter:].max()),
        "settled_1_cm_s": _or_nan(settling_time_s(time_s, error_m, 0.01)),
        "settled_1_mm_s": _or_nan(settling_time_s(time_s, error_m, 0.001)),
        "force_sum_end_n": float(np.linalg.norm(forces_n)),
        "round_trip_max_s": _extreme(run.local["round_trip_s"], np.max),
        "certified_round_trip_s": float(run.local["certified_round_trip_s"][-1]),
        "sub_task_error_start_rad_s": float(run.remote["sub_task_error_rad_s"][0]),
        "sub_task_error_max_rad_s": float(run.remote["sub_task_error_rad_s"].max()),
        "sub_task_error_end_rad_s": float(run.remote["sub_task_error_rad_s"][end].mean()),
        "midpoint_distance_min_m": _extreme(derived["remote"]["midpoint_distance_m"], np.min),
        "link_distance_min_m": _extreme(derived["remote"]["link_distance_m"], np.min),
        **_null_space_leak(session, run.remote),
        **_energy(session, run, energy_j),
    }
    for site, rows in pairs:
        manipulability = derived[site]["manipulability"]
        figures |= {
            f"{site}_torque_max_nm": float(np.abs(rows["torque_nm"]).max()),
            f"{site}_joint_speed_max_rad_s": float(np.abs(rows["q_dot"]).max()),
            f"{site}_coupling_force_max_n": float(np.abs(rows["coupling_force_n"]).max()),
            f"{site}_age_max_s": _extreme(rows["one_way_delay_s"], np.max),
            f"{site}_manipulability_start": float(manipulability[0]),
            f"{site}_manipulability_end": float(manipulability[-1]),
            f"{site}_manipulability_min": float(manipulability.min()),
        }
        for axis, force in zip("xyz", rows["external_force_n"][end].mean(axis=0), strict=False):
            figures[f"{site}_external_force_end_{axis}_n"] = float(force)
        for axis, position in zip("xyz", rows["position_m"][-1], strict=False):
            figures[f"{site}_position_end_{axis}_m"] = float(position)
    return figures


def energy_trace_j(session: Session, run: Run, window_s: tuple[float, float] | None) -> FloatArray:
    """Return V of `LyapunovKrasovskii` [J] at every tick, without external work; (0,) if unasked.

    `window_s` holds the greatest ages d̄_l, d̄_r of the samples in use.
    """
    if window_s is None:
        return np.empty(0)
    functional = LyapunovKrasovskii(coupling_of(session.coupling), *window_s)
    period_s = session.period_ns * 1e-9
    local_robot = robot_of(session, SiteId.LOCAL)
    energies = np.empty(len(run.local))
    remote_terms = _remote_terms(session, run.remote)
    for tick, (local, remote) in enumerate(zip(run.local, run.remote, strict=True)):
        M = local_robot.terms(local["q"], local["q_dot"]).M
        terms, zeta = next(remote_terms)
        energies[tick] = functional.update(
            SiteMotion(local["q_dot"], M, local["velocity_m_s"]),
            SiteMotion(terms.q_dot - zeta, terms.M, terms.X_dot),
            local["position_m"] - remote["position_m"],
            period_s,
        ).total
    return energies


def _energy(session: Session, run: Run, energy_j: FloatArray) -> Measures:
    """Return the greatest rise of V above its least value before, and what a tick may add to it.

    A first-order integrator's local error is of order h²: over a tick the held torque does
    ½h²q̈ᵀMq̈ that the tick's first power would not (docs/theory.md, 8.3). The tolerance is that at
    the run's greatest acceleration.
    """
    if not len(energy_j):
        return {}
    held_j = np.zeros(len(energy_j) - 1)
    for site, rows in zip(SiteId, (run.local, run.remote), strict=True):
        robot = robot_of(session, site)
        for tick, step in enumerate(np.diff(rows["q_dot"], axis=0)):
            M = robot.terms(rows["q"][tick], rows["q_dot"][tick]).M
            held_j[tick] += 0.5 * float(step @ M @ step)
    return {
        "energy_start_j": float(energy_j[0]),
        "energy_end_j": float(energy_j[-1]),
        "energy_rise_j": float((energy_j - np.minimum.accumulate(energy_j)).max()),
        "energy_tick_rise_j": float(np.diff(energy_j, prepend=energy_j[0]).max()),
        "energy_tick_tolerance_j": float(held_j.max(initial=0.0)),
    }


def _null_space_leak(session: Session, rows: RowArray) -> Measures:
    """Return ‖ζ‖ [rad/s], and max ‖Jζ‖ [m/s], which (4) wants zero, over evenly spaced ticks."""
    if not session.remote.sub_tasks:
        return dict.fromkeys(_NULL_SPACE, 0.0)
    every = max(1, len(rows) // _POSES_MEASURED)
    speeds = np.array(
        [
            (np.linalg.norm(zeta), np.linalg.norm(terms.J @ zeta))
            for terms, zeta in _remote_terms(session, rows[::every])
        ]
    )
    largest = (speeds[0, 0], *speeds.max(axis=0))
    return dict(zip(_NULL_SPACE, map(float, largest), strict=True))


def _remote_terms(session: Session, rows: RowArray) -> Iterator[tuple[RobotTerms, FloatArray]]:
    """Yield the remote robot's terms and the controller's ζ at each row."""
    robot, controller = robot_of(session, SiteId.REMOTE), build_remote_controller(session)
    for row in rows:
        terms = robot.terms(row["q"], row["q_dot"])
        zeta, _ = controller.reference(terms, row["time_ns"] * 1e-9)
        yield terms, zeta


def _extreme(values: FloatArray, reduce: Callable[[FloatArray], np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(reduce(known)) if len(known) else nan


def _or_nan(value: float | None) -> float:
    return nan if value is None else value
