"""Fig. 5: the paper's bench with an obstacle, avoidance off and on."""

from pathlib import Path

from experiments.case import Case
from experiments.plots import sub_task_figure
from experiments.report import Claim, Figure, Section, Table, Verdict
from experiments.studies.figure_4 import _REST_M
from experiments.study import Outcomes, Study

_DURATION_S = 22.0
_WITHOUT = Case("figure_5_without", "figure_5.toml", _DURATION_S, {"remote.sub_tasks": None})
_WITH = Case("figure_5_with", "figure_5.toml", _DURATION_S)
_BOUNDED = Case(
    "figure_5_bounded",
    "figure_5.toml",
    _DURATION_S,
    {"remote.sub_tasks": [{"kind": "obstacle", "gain": 5000.0}], "remote.null_space": None},
)
_RUNS = {
    "without": _WITHOUT,
    "with the paper's function": _WITH,
    "with `obstacle`, whole links, bounded": _BOUNDED,
}


def _section(outcomes: Outcomes, folder: Path) -> Section:
    without, with_task, bounded = (outcomes[case.name] for case in _RUNS.values())
    off, on, ours = without.measures, with_task.measures, bounded.measures
    (obstacle,) = _WITH.session().remote.obstacles
    r, R = obstacle.collision_radius_m, obstacle.safe_radius_m
    sub_task_figure(folder / "figure_5.png", without, with_task, "obstacle avoidance")
    return Section(
        "Fig. 5: the bench, obstacle avoidance",
        f"The bench of Fig. 4 with the paper's obstacle (r = {r} m, R = {R} m), avoidance off and "
        "on. How deep the arm without avoidance goes depends on what is not printed.",
        (
            Claim(
                "Fig. 5",
                "the remote arm avoids the obstacle while the end effectors synchronise",
                f"nearest midpoint {off['midpoint_distance_min_m']:.3f} m without, "
                f"{on['midpoint_distance_min_m']:.3f} m with; error at rest "
                f"{off['error_end_m'] * 1e3:.1f} and {on['error_end_m'] * 1e3:.1f} mm",
                Verdict.of(
                    off["midpoint_distance_min_m"] < r < on["midpoint_distance_min_m"]
                    and max(off["error_end_m"], on["error_end_m"]) < _REST_M
                ),
            ),
            Claim(
                "docs/theory.md, Section 7 (not in the paper)",
                "the bounded avoidance of whole links does as much",
                f"nearest point of a link {ours['link_distance_min_m']:.3f} m, with the paper's "
                f"function {on['link_distance_min_m']:.3f} m, without "
                f"{off['link_distance_min_m']:.3f} m",
                Verdict.of(ours["link_distance_min_m"] >= on["link_distance_min_m"]),
            ),
        ),
        (
            Table(
                "The three runs:",
                (
                    *("avoidance", "nearest midpoint [m]", "nearest point of a link [m]"),
                    *("error, largest [mm]", "at rest [mm]", "largest remote torque [N·m]"),
                    "max ‖ζ‖ [rad/s]",
                ),
                tuple(
                    (
                        label,
                        f"{m['midpoint_distance_min_m']:.3f}",
                        f"{m['link_distance_min_m']:.3f}",
                        f"{m['error_max_m'] * 1e3:.1f}",
                        f"{m['error_end_m'] * 1e3:.2f}",
                        f"{m['remote_torque_max_nm']:.2f}",
                        f"{m['null_space_speed_max_rad_s']:.2f}",
                    )
                    for label, m in zip(_RUNS, (off, on, ours), strict=True)
                ),
            ),
        ),
        (Figure("figure_5.png", "Fig. 5: obstacle avoidance off and on"),),
    )


STUDY = Study("figure_5", "The bench: obstacle avoidance", tuple(_RUNS.values()), _section)
