"""Whether the energy of the proof rose while nobody pushed and the loop was certified."""

import numpy as np
import numpy.typing as npt

from experiments.measures import energy_trace_j
from experiments.simulation import Run
from site_runtime.session import Session
from site_runtime.supervisor import State
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

LEAST_S = 0.5
SHARE = 0.02  # of the interval's greatest energy: ticks that come late hold their torque longer
FLOOR_J = 1e-3
_MOTION = ("q", "q_dot", "position_m", "velocity_m_s")


def energy_rises(session: Session, local: RowArray, remote: RowArray) -> tuple[int, list[str]]:
    """Return how many free intervals there were, and in words where V rose.

    Rows are of one run of each site, on one clock. An interval is free where both sites are ENGAGED
    with their whole gains and not on the way back from HOLD, nothing is cut, nobody pushes, and the
    loop is younger than certified.
    """
    if min(len(local), len(remote)) < 2:
        return 0, []
    period_ns = session.period_ns
    start_ns = max(rows["stamp_ns"][0] for rows in (local, remote))
    end_ns = min(rows["stamp_ns"][-1] for rows in (local, remote))
    grid_ns = np.arange(start_ns, end_ns, period_ns)
    free = np.logical_and.reduce([_free(session, rows, grid_ns) for rows in (local, remote)])
    checked, rises = 0, []
    for first, last in _stretches(free):
        if (last - first) * period_ns < LEAST_S * 1e9:
            continue
        checked += 1
        rise_j, most_j = _rise(session, local, remote, grid_ns[first:last])
        if rise_j > SHARE * most_j + FLOOR_J:
            rises.append(
                f"V rose by {rise_j:.4f} J, of {most_j:.4f} J, from {grid_ns[first]} ns on"
            )
    return checked, rises


def _free(session: Session, rows: RowArray, grid_ns: npt.NDArray[np.int64]) -> BoolArray:
    """Which instants of the grid are free, as one site sees them."""
    engaged = rows["state"] == State.ENGAGED
    left_ns = np.where(engaged, np.iinfo(np.int64).min, rows["stamp_ns"])
    since_ns = rows["stamp_ns"] - np.maximum.accumulate(left_ns)
    blended = since_ns > (session.engagement.blend_s + session.engagement.ramp_s) * 1e9
    free = (
        engaged
        & (blended | (left_ns.max() == np.iinfo(np.int64).min))
        & (rows["force_share"] == 1.0)
        & (rows["cut"] == 0)
        & (rows["external_force_n"] == 0.0).all(axis=1)
        & (rows["loop_bound_s"] <= rows["certified_round_trip_s"])
    )
    index = np.clip(np.searchsorted(rows["stamp_ns"], grid_ns, side="right") - 1, 0, None)
    return free[index] & (grid_ns - rows["stamp_ns"][index] < 20 * session.period_ns)


def _stretches(free: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], free, [False]))))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _rise(
    session: Session, local: RowArray, remote: RowArray, grid_ns: npt.NDArray[np.int64]
) -> tuple[float, float]:
    """Greatest rise of V above its least value before, and its greatest value [J]."""
    windows_s = []
    for rows in (remote, local):  # d̄_l is the age of the local samples, which the remote site tells
        during = (rows["stamp_ns"] >= grid_ns[0]) & (rows["stamp_ns"] <= grid_ns[-1])
        windows_s.append(float(rows["one_way_delay_s"][during].max()) + session.period_ns * 1e-9)
    # V₃ looks back: what moved before the interval is in it
    before_ns = np.arange(grid_ns[0] - round(max(windows_s) * 1e9), grid_ns[0], session.period_ns)
    whole_ns = np.concatenate((before_ns, grid_ns))
    run = Run(_at(local, whole_ns), _at(remote, whole_ns), ())
    energy_j = energy_trace_j(session, run, (windows_s[0], windows_s[1]))[len(before_ns) :]
    rise_j = energy_j - np.minimum.accumulate(energy_j)
    return float(rise_j.max()), float(energy_j.max())


def _at(rows: RowArray, grid_ns: npt.NDArray[np.int64]) -> RowArray:
    """Rows whose motion is that at these instants; positions are those told to the peer."""
    resampled = np.zeros(len(grid_ns), rows.dtype)
    told_m = rows["position_m"] - rows["offset_m"]
    stamps_ns = rows["stamp_ns"].astype(np.float64)
    for name in _MOTION:
        for axis in range(rows[name].shape[1]):
            values = told_m if name == "position_m" else rows[name]
            resampled[name][:, axis] = np.interp(grid_ns, stamps_ns, values[:, axis])
    return resampled
