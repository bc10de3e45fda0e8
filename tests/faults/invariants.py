"""What no fault may ever cause, asked of a site's rows afterwards."""

import numpy as np
import numpy.typing as npt

from control_law.ramp import smooth_ramp
from site_runtime.keys import SiteId
from site_runtime.margin import margin_of
from site_runtime.session import Session, StiffnessCoupling
from site_runtime.supervisor import State
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

TORQUE = ("ENGAGED", "HOLD", "RELEASED")
DRIVEN_BY_COUPLING = ("ENGAGED", "HOLD")
POINT_M_S = 2.0  # faster than the arms ever go, blending included
ROUNDING_N = 0.05


def among(rows: RowArray, names: tuple[str, ...]) -> BoolArray:
    """Which rows (r,) are in one of these states."""
    values = [State[name] for name in names if name in State.__members__]
    return np.isin(rows["state"], values)


def violations(rows: RowArray, session: Session, site: SiteId) -> list[str]:
    """Return what is wrong in the rows of one run, in words; nothing if all is well."""
    if not len(rows):
        return []
    settings = session.coupling
    assert isinstance(settings, StiffnessCoupling)
    ceiling_n = np.array(settings.force_ceiling_n)
    limit_nm = np.array(session.site(site).limits.torque_nm)
    torque_nm, force_n = rows["torque_nm"], rows["coupling_force_n"]
    checks = [
        (~np.isfinite(torque_nm).all(axis=1), "a torque that is not finite"),
        ((np.abs(torque_nm) > limit_nm).any(axis=1), "torque above its limit"),
        ((torque_nm != 0.0).any(axis=1) & ~among(rows, TORQUE), "torque outside the driven states"),
        ((np.abs(force_n) > ceiling_n + 1e-9).any(axis=1), "coupling force above the ceiling"),
    ]
    margin = margin_of(session)
    beyond = rows["loop_bound_s"] > margin.certified_s
    proven = np.ones(len(rows))
    proven[beyond] = [
        margin.share(round(age_s * 1e9) - 2 * session.period_ns)
        for age_s in rows["loop_bound_s"][beyond]
    ]
    least = session.engagement.derate_to * (1.0 - 1e-6)  # of a rounded age
    checks.append((among(rows, ("ENGAGED",)) & (proven < least), "ENGAGED on a loop too old"))
    excess_n = force_jumps_n(rows, session)
    checks.append((excess_n > 0.0, f"the coupling force jumped, by up to {excess_n.max():.2f} N"))
    return [
        f"{site.label}: {what} in {np.count_nonzero(wrong)} ticks, first in "
        f"{State(rows['state'][np.argmax(wrong)]).name} at {rows['stamp_ns'][np.argmax(wrong)]} ns"
        for wrong, what in checks
        if wrong.any()
    ]


def force_jumps_n(rows: RowArray, session: Session) -> FloatArray:
    """How much more than allowed the force changed since the tick before (r,) [N], ≤ 0 if all well.

    Allowed is what the ramp after engagement adds, and the stiffness times what the robot moved and
    its point may have moved: at a bounded speed, over the tick and, while ENGAGED, over the time
    between the peer's samples. Out of a driven state the force may vanish.
    """
    settings = session.coupling
    assert isinstance(settings, StiffnessCoupling)
    stiffness = np.array(settings.stiffness_n_per_m)
    ceiling_n = np.array(settings.force_ceiling_n)
    ramp_s = session.engagement.ramp_s
    driven = among(rows, DRIVEN_BY_COUPLING)
    engaged = among(rows, ("ENGAGED",))
    stamp_s = rows["stamp_ns"] * 1e-9
    tick_s = np.diff(stamp_s)
    # from one ENGAGED tick to the next, the sample in use may have waited on the way
    newer_s = np.diff(stamp_s - np.nan_to_num(rows["one_way_delay_s"]))
    newer_s = np.where(engaged[1:] & engaged[:-1], np.clip(newer_s, 0.0, None), 0.0)
    moved_m = np.abs(np.diff(rows["position_m"], axis=0))
    moved_m += (POINT_M_S * (tick_s + newer_s))[:, None]
    _, steepest = smooth_ramp(ramp_s / 2, ramp_s)
    allowed_n = stiffness * moved_m + ceiling_n * (steepest * tick_s)[:, None]
    force_n = np.where(driven[:, None], rows["coupling_force_n"], 0.0)
    excess_n = (np.abs(np.diff(force_n, axis=0)) - allowed_n).max(axis=1, initial=-np.inf)
    comparable = (np.diff(rows["sequence"]) == 1) & driven[1:]
    excess_n = np.where(comparable, excess_n - ROUNDING_N, 0.0)
    return np.concatenate(([0.0], excess_n))
