"""Fig. 3: obstacle avoidance off and on, under the force of Fig. 1."""

from pathlib import Path

from experiments.case import Case
from experiments.plots import sub_task_figure
from experiments.report import Claim, Figure, Section, Verdict
from experiments.studies.figure_2 import WITHOUT
from experiments.study import Outcomes, Study

WITH = Case("figure_3_with", "figure_3.toml", 260.0, until_settled=True)


def _section(outcomes: Outcomes, folder: Path) -> Section:
    without, with_task = outcomes[WITHOUT.name], outcomes[WITH.name]
    off, on = without.measures, with_task.measures
    (obstacle,) = WITH.session().remote.obstacles
    r, R = obstacle.collision_radius_m, obstacle.safe_radius_m
    sub_task_figure(folder / "figure_3.png", without, with_task, "obstacle avoidance")
    return Section(
        "Fig. 3: obstacle avoidance",
        "The same pair, gains and pulses as in Fig. 2, with the paper's avoidance function on the "
        "links' midpoints. The dashed circles are r and R.",
        (
            Claim(
                "Fig. 3(b)",
                "the arm avoids the obstacle (its links' midpoints keep farther off than r) while "
                "the end effectors synchronise",
                f"nearest midpoint {off['midpoint_distance_min_m']:.3f} m without, "
                f"{on['midpoint_distance_min_m']:.3f} m with (r = {r} m, R = {R} m); 1 mm in "
                f"{off['settled_1_mm_s']:.0f} and {on['settled_1_mm_s']:.0f} s",
                Verdict.of(
                    off["midpoint_distance_min_m"] < r < on["midpoint_distance_min_m"]
                    and on["error_end_m"] < 1e-3
                ),
            ),
            Claim(
                "Fig. 3, as a user may read it",
                "no point of a link comes nearer than r",
                f"nearest point of a link {on['link_distance_min_m']:.3f} m: the paper guards "
                "midpoints only",
                Verdict.of(on["link_distance_min_m"] > r),
            ),
            Claim(
                "Fig. 3(c)",
                "obstacle avoidance also raises the manipulability",
                f"at the end {off['remote_manipulability_end']:.4f} m⁴ without, "
                f"{on['remote_manipulability_end']:.4f} with",
                Verdict.of(on["remote_manipulability_end"] > off["remote_manipulability_end"]),
            ),
        ),
        figures=(Figure("figure_3.png", "Fig. 3: obstacle avoidance off and on"),),
    )


STUDY = Study("figure_3", "Obstacle avoidance off and on", (WITHOUT, WITH), _section)
