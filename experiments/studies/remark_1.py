"""Remark 1: a constant force, in free motion and against a wall, below and above the ceiling."""

from math import atan, hypot, tan
from pathlib import Path

from experiments.case import Case
from experiments.plots import COLOURS, curves, panels, save
from experiments.report import Claim, Figure, Section, Table, Verdict
from experiments.study import Outcomes, Study
from site_runtime.session_edit import TomlValue

_FORCE = "local.operator.force_n"
_ABOVE_N, _PAPER_N = 7.0, 1.0
_WALL = Case("remark_1_wall", "remark_1.toml", 20.0)
_ABOVE = Case("remark_1_above", "remark_1.toml", 30.0, {_FORCE: [_ABOVE_N, 0.0]})
_FREE = Case("remark_1_free", "remark_1.toml", 60.0, {"remote.environment.walls": None})
_AS_PRINTED: dict[str, TomlValue | None] = {
    "coupling": {"law": "paper", "omega": [1.0, 1.0], "b": [1.0, 1.0]},
    _FORCE: [_PAPER_N, 0.0],
}
_PAPER = Case("remark_1_omega_1", "remark_1.toml", 60.0, _AS_PRINTED)
_RUNS = {
    "2.5 N against the wall, K = 200 N/m, ceiling 5 N": _WALL,
    f"{_ABOVE_N:g} N against the wall, above the ceiling": _ABOVE,
    "2.5 N in free motion": _FREE,
    f"{_PAPER_N:g} N against the wall, Ω = 1 N/m as in Section VI": _PAPER,
}
_SINGULAR_M4 = 1e-6
_BALANCED_N = 1e-3


def _section(outcomes: Outcomes, folder: Path) -> Section:
    wall, above, free, paper = (outcomes[case.name].measures for case in _RUNS.values())
    reach_m = sum(_WALL.session().local.robot.lengths_m)  # type: ignore[union-attr]
    wall_x_m = _WALL.session().remote.environment.walls[0].point_m[0]
    farthest_n = atan(reach_m - wall_x_m)
    figure, axes = panels(1, 3, (15.0, 4.2))
    for (label, case), colour in zip(_RUNS.items(), COLOURS, strict=False):
        outcome = outcomes[case.name]
        for place, (title, values) in enumerate(
            (
                (
                    "force of the environment in X [N]",
                    outcome.vector("remote_external_force")[:, 0],
                ),
                ("‖TTE‖ [m]", outcome.distance_m()),
                ("local det(J_l J_lᵀ) [m⁴]", outcome.scalar("local_manipulability")),
            )
        ):
            curves(
                axes[place],
                outcome.time_s,
                [(label, values, colour)],
                title,
                logarithmic=place == 2,
            )
    save(figure, folder / "remark_1.png")
    return Section(
        "Remark 1: a constant force",
        "The paper's pair under Theorem B's damping, with a constant force on the local end "
        "effector from 2 s on and a stiff wall at x = 0.3 m before the remote one.",
        (
            Claim(
                "Remark 1, (20)",
                "in contact the forces balance, F_l + F_r → 0, while Ω_jN_j ≥ F_l",
                f"2.5 N below a ceiling of 5 N: F_r = {wall['remote_external_force_end_x_n']:.4f} "
                f"N, ‖F_l + F_r‖ = {wall['force_sum_end_n']:.0e} N",
                Verdict.of(wall["force_sum_end_n"] < _BALANCED_N),
            ),
            Claim(
                "Remark 1, with Section VI's gains",
                "the same with Ω = 1 N/m and p = atan, whose Ω_jN_j = π/2 N exceeds 1 N",
                f"F_r = {paper['remote_external_force_end_x_n']:.3f} N of {_PAPER_N:g} N, local "
                f"det(J_lJ_lᵀ) = {paper['local_manipulability_end']:.0e} m⁴: 1 N would need an "
                f"error of tan 1 = {tan(1.0):.2f} m, the arm reaches {reach_m:.2f} m, so at most "
                f"{farthest_n:.2f} N. With a ceiling within reach it holds",
                Verdict.only_if(
                    paper["force_sum_end_n"] < _BALANCED_N, wall["force_sum_end_n"] < _BALANCED_N
                ),
            ),
            Claim(
                "Remark 1",
                "if Ω_jN_j < F_l, then F_r → −ΩP(e_l⁰)",
                f"{_ABOVE_N:g} N above a ceiling of 5 N: F_r = "
                f"{above['remote_external_force_end_x_n']:.3f} N, coupling "
                f"{above['local_coupling_force_max_n']:.3f} N; the local robot is driven to its "
                f"reach, det(J_lJ_lᵀ) = {above['local_manipulability_end']:.0e} m⁴",
                Verdict.of(
                    abs(
                        abs(above["remote_external_force_end_x_n"])
                        - above["local_coupling_force_max_n"]
                    )
                    < 0.01 * above["local_coupling_force_max_n"]
                ),
            ),
            Claim(
                "Remark 1",
                "a constant force in free motion drives the local robot to a singularity, and main "
                "task and sub-task are achieved",
                f"after {free['duration_s']:.0f} s det(J_lJ_lᵀ) from "
                f"{free['local_manipulability_start']:.3f} to "
                f"{free['local_manipulability_end']:.0e} m⁴, X_l = "
                f"({free['local_position_end_x_m']:.3f}, "
                f"{free['local_position_end_y_m']:.3f}) m, error "
                f"{free['error_end_m'] * 1e3:.1f} mm and still falling: it turns toward the force",
                Verdict.of(
                    free["local_manipulability_end"] < _SINGULAR_M4
                    and free["error_end_m"] < 0.1 * free["error_max_m"]
                ),
            ),
        ),
        (
            Table(
                "The four runs at their ends:",
                (
                    *("run", "F_l in X [N]", "F_r in X [N]", "‖F_l + F_r‖ [N]", "TTE [mm]"),
                    *("‖X_l‖ [m]", "det(J_lJ_lᵀ) [m⁴]", "largest local torque [N·m]"),
                ),
                tuple(
                    (
                        label,
                        f"{m['local_external_force_end_x_n']:.3f}",
                        f"{m['remote_external_force_end_x_n']:.3f}",
                        f"{m['force_sum_end_n']:.1e}",
                        f"{m['error_end_m'] * 1e3:.1f}",
                        f"{hypot(m['local_position_end_x_m'], m['local_position_end_y_m']):.4f}",
                        f"{m['local_manipulability_end']:.0e}",
                        f"{m['local_torque_max_nm']:.2f}",
                    )
                    for label, m in zip(_RUNS, (wall, above, free, paper), strict=True)
                ),
            ),
        ),
        (
            Figure(
                "remark_1.png", "Remark 1: force, error, and the local robot's way to a singularity"
            ),
        ),
    )


STUDY = Study("remark_1", "A constant force", tuple(_RUNS.values()), _section)
