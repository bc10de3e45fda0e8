"""Fig. 4: the end effectors of the paper's bench follow each other, without a sub-task."""

from pathlib import Path

import numpy as np

from experiments.case import Case
from experiments.plots import synchronisation_figure
from experiments.report import Claim, Figure, Section, Verdict
from experiments.study import Outcomes, Study

_CASE = Case("figure_4", "figure_4.toml", 30.0)
_REST_M = 2e-3


def _section(outcomes: Outcomes, folder: Path) -> Section:
    outcome = outcomes[_CASE.name]
    m = outcome.measures
    travelled_m = np.ptp(outcome.vector("remote_position"), axis=0)
    force_n = np.abs(outcome.vector("local_external_force")).max()
    synchronisation_figure(folder / "figure_4.png", outcome, "Fig. 4: the bench without a sub-task")
    return Section(
        "Fig. 4: the bench, synchronisation",
        "The paper's experiment as a simulation: a PHANToM of two joints and a robot of four, with "
        "the paper's links. Masses, gains, delays and the hand's force are not printed; those in "
        "experiments/figure_4.toml are ours, with encoders, friction and torque limits of the "
        "devices' size, so that the error at rest is that of friction.",
        (
            Claim(
                "Fig. 4",
                "the end effectors' positions synchronise in X and Y under the operator's force",
                f"over {travelled_m[0]:.2f} by {travelled_m[1]:.2f} m under forces up to "
                f"{force_n:.1f} N: error never above {m['error_max_m'] * 1e3:.0f} mm in motion, "
                f"{m['error_end_m'] * 1e3:.1f} mm at rest",
                Verdict.of(m["error_end_m"] < _REST_M and not outcome.failures),
            ),
        ),
        figures=(Figure("figure_4.png", "Fig. 4: force of the hand and both end effectors"),),
    )


STUDY = Study("figure_4", "The bench: synchronisation", (_CASE,), _section)
