"""What a user can run into with the method as printed, and the default that avoids it."""

from pathlib import Path

import numpy as np

from experiments.case import Case, Outcome
from experiments.report import Claim, Section, Table, Verdict
from experiments.studies.figure_2 import WITH as SINGULARITY
from experiments.studies.figure_3 import WITH as OBSTACLE
from experiments.study import Outcomes, Study, both_ways
from remote_site.sub_tasks import build_sub_task
from site_runtime.certification import certify, sampling_ratio
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session_edit import TomlValue

_NO_HAND: dict[str, TomlValue | None] = {"local.operator": None}
_MIDPOINT_OF_LINK_2_M = (0.4241, 0.3545)  # in the remote arm's first pose


def _obstacle_at(depth_m: float, **task: TomlValue) -> dict[str, TomlValue | None]:
    """Put the obstacle so that link 2's midpoint starts `depth_m` from its centre."""
    x_m, y_m = _MIDPOINT_OF_LINK_2_M
    return {
        **_NO_HAND,
        "remote.obstacles[0].center_m": [x_m - depth_m, y_m],
        "remote.sub_tasks": [task],
    }


_PAPER_TASK: dict[str, TomlValue] = {"kind": "paper_obstacle", "gain": 1.0}
_BOUNDED_TASK: dict[str, TomlValue] = {"kind": "obstacle", "gain": 100.0}
_SAFE_NULL_SPACE: TomlValue = {"regularisation": 1e-4, "rate_limit_rad_s": 1.0}


def _avoidance(name: str, depth_m: float, *, safe: bool) -> Case:
    changes = _obstacle_at(depth_m, **(_BOUNDED_TASK if safe else _PAPER_TASK))
    if safe:
        changes["remote.null_space"] = _SAFE_NULL_SPACE
        changes["engagement.sub_task_ramp_s"] = 0.5
    return Case(name, "figure_3.toml", 5.0, changes)


_INSIDE = _avoidance("hazard_inside_paper", 0.133, safe=False)
_INSIDE_SAFE = _avoidance("hazard_inside_default", 0.133, safe=True)
_BLIND = _avoidance("hazard_blind_paper", 0.025, safe=False)
_BLIND_SAFE = _avoidance("hazard_blind_default", 0.025, safe=True)

# 0.04 N of backdrive friction at the tip of a link of 0.38 m
_FRICTION: dict[str, TomlValue | None] = {
    "local.device.coulomb_friction_nm": 0.0152,
    "remote.device.coulomb_friction_nm": 0.0152,
}
_STICKING = Case("hazard_friction_paper", "theorem_b.toml", 30.0, _FRICTION)
_STICKING_STIFF = Case("hazard_friction_stiff", "theorems.toml", 10.0, _FRICTION)

# Nearly straight: where damping weighs most against inertia, by the search of `farhand certify`
_STRAIGHT: dict[str, TomlValue | None] = {
    "remote.device.initial_position_rad": [2.1, 0.02, 0.03],
}
_ROD: dict[str, TomlValue | None] = {**_STRAIGHT, "remote.robot.mass": "rod"}
_LATE: dict[str, TomlValue | None] = {"remote.device.torque_delay_s": 0.001}
_ROD_LATE = Case("hazard_rod_late_paper", "paper_free.toml", 5.0, {**_ROD, **_LATE})
_ROD_AT_ONCE = Case("hazard_rod_paper", "paper_free.toml", 5.0, _ROD)
_ROD_LATE_B = Case("hazard_rod_late_task_damping", "theorem_b.toml", 5.0, {**_ROD, **_LATE})


def _more_damping(name: str, one_way_s: float) -> Case:
    """Damp in proportion to the delay, as (17) has it, from the paper's gains at 0.2 s each way."""
    delay: TomlValue = {"model": "constant", "delay_s": one_way_s}
    share = one_way_s / 0.2
    return Case(
        name,
        "paper_free.toml",
        5.0,
        {
            **_STRAIGHT,
            **both_ways("delay", delay),
            "local.damping.joint_nm_s": [0.96 * share] * 2,
            "remote.damping.joint_nm_s": [3.2 * share] * 3,
        },
    )


_MORE_DAMPING = _more_damping("hazard_damping_2_s", 1.0)
_SOME_DAMPING = _more_damping("hazard_damping_0_8_s", 0.4)


def _section(outcomes: Outcomes, folder: Path) -> Section:
    m = {name: outcome.measures for name, outcome in outcomes.items()}
    inside, inside_safe = m[_INSIDE.name], m[_INSIDE_SAFE.name]
    blind, blind_safe = m[_BLIND.name], m[_BLIND_SAFE.name]
    outside_rad_s = m[OBSTACLE.name]["null_space_speed_max_rad_s"]
    sticking, stiff = m[_STICKING.name], m[_STICKING_STIFF.name]
    damped_leak_m_s, scale_rad_s = _damped_leak(outcomes[SINGULARITY.name])
    leak_m_s = m[SINGULARITY.name]["null_space_leak_m_s"]
    more = certify(_MORE_DAMPING.session())
    more_ratio, some_ratio = (
        sampling_ratio(case.session(), SiteId.REMOTE).ratio
        for case in (_MORE_DAMPING, _SOME_DAMPING)
    )
    rod_ratio = sampling_ratio(_ROD_LATE.session(), SiteId.REMOTE).ratio
    rod_b_ratio = sampling_ratio(_ROD_LATE_B.session(), SiteId.REMOTE).ratio
    rows = (
        (
            "the avoidance function of [21] switched on inside R (0.133 m from the centre)",
            f"‖ζ‖ up to {inside['null_space_speed_max_rad_s']:.0f} rad/s, torque up to "
            f"{inside['remote_torque_max_nm']:.0f} N·m{_ended(outcomes[_INSIDE.name])}",
            "`obstacle`, rate limit 1 rad/s, ramp 0.5 s: ‖ζ‖ up to "
            f"{inside_safe['null_space_speed_max_rad_s']:.2f} rad/s, torque up to "
            f"{inside_safe['remote_torque_max_nm']:.2f} N·m, midpoint at the end "
            f"{_end_depth(outcomes[_INSIDE_SAFE.name]):.3f} m from the centre",
        ),
        (
            "the same function inside r (0.025 m from the centre): no push at all, and beyond all "
            "bounds at r",
            f"‖ζ‖ {blind['null_space_speed_start_rad_s']:.1f} rad/s at the start, up to "
            f"{blind['null_space_speed_max_rad_s']:.0e} where the main task drags a midpoint over "
            f"r{_ended(outcomes[_BLIND.name])}",
            f"`obstacle`: ‖ζ‖ up to {blind_safe['null_space_speed_max_rad_s']:.2f} rad/s, the "
            f"midpoint after 5 s {_end_depth(outcomes[_BLIND_SAFE.name]):.3f} m from the centre",
        ),
        (
            "a damped pseudo-inverse (λ = 0.05) in (4)",
            f"along Fig. 2's way max ‖Jζ‖ {damped_leak_m_s:.1e} m/s at ‖ζ‖ up to "
            f"{scale_rad_s:.1e} rad/s: the sub-task moves the end effector",
            f"the adjugate projector: {leak_m_s:.0e} m/s",
        ),
        (
            "0.04 N of friction at Ω = 1 N/m",
            f"error left {sticking['error_end_m'] * 1e3:.0f} mm",
            f"50 N/m: {stiff['error_end_m'] * 1e3:.2f} mm",
        ),
        (
            "links as rods, one tick of latency, the paper's Λ",
            f"straight, a = T_s λ_max(M⁻¹Λ) = {rod_ratio:.2f}, limit 1 one tick late: joints at "
            f"{_speed(outcomes[_ROD_LATE.name])}; without the latency, limit 2: "
            f"{_speed(outcomes[_ROD_AT_ONCE.name])}",
            f"task damping by Theorem B, a = {rod_b_ratio:.2f}, one tick late: "
            f"{_speed(outcomes[_ROD_LATE_B.name])}",
        ),
    )
    return Section(
        "What a user can run into",
        "Hazards of the method as printed, each run on the same code, and the setting that avoids "
        "it: the default where there is one. The force ceiling that cannot be reached, and the "
        "local robot driven singular, are under Remark 1.",
        (
            Claim(
                "Section I",
                "larger delays are tolerated by simply increasing Λ “without any consequences”",
                f"Λ for a round trip of {more.certificates[0].round_trip_s:.2f} s by (17) makes "
                f"a = T_s λ_max(M⁻¹Λ) = {more_ratio:.2f} at 1 kHz"
                f"{_ended(outcomes[_MORE_DAMPING.name])}; for 0.8 s, a = {some_ratio:.2f} "
                f"{_ended(outcomes[_SOME_DAMPING.name]) or 'runs'}: the sampled loop wants a < 2",
                Verdict.only_if(
                    not outcomes[_MORE_DAMPING.name].failures,
                    not outcomes[_SOME_DAMPING.name].failures,
                ),
            ),
            Claim(
                "Section V",
                "the avoidance function of [21] keeps the sub-task velocity bounded",
                f"‖ζ‖ up to {inside['null_space_speed_max_rad_s']:.0f} rad/s when switched on "
                f"inside R; entering from outside, Fig. 3, up to {outside_rad_s:.2f} rad/s",
                Verdict.only_if(
                    inside["null_space_speed_max_rad_s"] < 1.0,
                    outside_rad_s < 1.0,
                ),
            ),
        ),
        (Table("", ("hazard", "as printed", "what avoids it"), rows),),
    )


def _damped_leak(outcome: Outcome, damping: float = 0.05) -> tuple[float, float]:
    """Return max ‖Jζ‖ [m/s] and max ‖ζ‖ [rad/s] of ζ = (I − Jᵀ(JJᵀ + λ²I)⁻¹J)g along a run."""
    session = outcome.case.session()
    robot = robot_of(session, SiteId.REMOTE)
    sub_task = build_sub_task(session.remote, robot)
    if sub_task is None:
        return 0.0, 0.0
    leak_m_s = speed_rad_s = 0.0
    for q, q_dot in zip(outcome.vector("remote_q"), outcome.vector("remote_q_dot"), strict=True):
        terms = robot.terms(q, q_dot)
        g, _ = sub_task.evaluate(terms)
        gram = terms.J @ terms.J.T + damping**2 * np.eye(len(terms.J))
        zeta = g - terms.J.T @ np.linalg.solve(gram, terms.J @ g)
        leak_m_s = max(leak_m_s, float(np.linalg.norm(terms.J @ zeta)))
        speed_rad_s = max(speed_rad_s, float(np.linalg.norm(zeta)))
    return leak_m_s, speed_rad_s


def _ended(outcome: Outcome) -> str:
    """Say when a run ended by a fault, or nothing."""
    if not outcome.failures:
        return ""
    return f": diverges, fault after {outcome.measures.get('duration_s', 0.0):.2f} s"


def _speed(outcome: Outcome) -> str:
    return f"{outcome.measures['remote_joint_speed_max_rad_s']:.2g} rad/s"


def _end_depth(outcome: Outcome) -> float:
    return float(outcome.scalar("remote_midpoint_distance_m")[-1])


STUDY = Study(
    "hazards",
    "What a user can run into",
    (
        *(_INSIDE, _INSIDE_SAFE, _BLIND, _BLIND_SAFE, SINGULARITY, OBSTACLE),
        *(_STICKING, _STICKING_STIFF, _ROD_LATE, _ROD_AT_ONCE, _ROD_LATE_B, _MORE_DAMPING),
        _SOME_DAMPING,
    ),
    _section,
)
