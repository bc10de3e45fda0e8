"""The paper's §VI in free motion: three sub-tasks, and the dampings of Theorems A and B.

The figures are invariants: the paper gives no absolute reference, so its final pose is one of a
continuum. Sessions of minutes are simulated once, on all cores; these are slow tests.
"""

import numpy as np
import pytest

from experiments.case import Case, Outcome
from experiments.runner import run_cases

pytestmark = pytest.mark.timeout(1500)

ONE_PERCENT = 0.01
SECOND_S, MILLIMETRE_M = 1.0, 1e-3
NO_HAND = {"local.operator": {"kind": "none"}}
# A little beyond the time at which the error is below 1 mm.
CASES = (
    Case("paper_free", "paper_free.toml", 202),
    Case("paper_obstacle", "figure_3.toml", 156, NO_HAND),
    Case("paper_singularity", "figure_2.toml", 139, NO_HAND),
    Case("theorem_a", "theorem_a.toml", 32),
    Case("theorem_b", "theorem_b.toml", 7),
)


@pytest.fixture(scope="session")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    return run_cases(CASES, tmp_path_factory.mktemp("paper"))


def error_at_m(outcome: Outcome, time_s: float) -> float:
    return float(np.interp(time_s, outcome.time_s, np.linalg.norm(outcome.error_m(), axis=1)))


NAMES = [case.name for case in CASES]
PAPER = [name for name in NAMES if name.startswith("paper")]


@pytest.mark.parametrize("name", NAMES)
def test_all_start_where_the_paper_does(outcomes: dict[str, Outcome], name: str) -> None:
    run = outcomes[name]
    assert run.failures == ()
    assert run.time_s[0] == 0.0
    assert run.measures["error_start_m"] == pytest.approx(1.481, abs=MILLIMETRE_M / 2)
    assert run.measures["remote_manipulability_start"] == pytest.approx(0.0156, abs=5e-5)


@pytest.mark.parametrize(
    ("name", "centimetre_s", "millimetre_s"),
    [("paper_free", 135, 197), ("paper_singularity", 97, 135), ("paper_obstacle", 110, 151)],
)
def test_the_arms_synchronise_in_the_papers_time(
    outcomes: dict[str, Outcome], name: str, centimetre_s: float, millimetre_s: float
) -> None:
    run = outcomes[name]
    assert run.measures["settled_1_cm_s"] == pytest.approx(centimetre_s, rel=ONE_PERCENT)
    assert run.measures["settled_1_mm_s"] == pytest.approx(millimetre_s, rel=ONE_PERCENT)


@pytest.mark.parametrize(
    ("name", "errors_m"),
    [
        ("paper_free", (0.391, 0.349, 0.297, 0.136)),
        ("paper_singularity", (0.392, 0.351, 0.297, 0.080)),
        ("paper_obstacle", (0.391, 0.349, 0.297, 0.112)),
    ],
)
def test_the_error_falls_as_in_the_figures(
    outcomes: dict[str, Outcome], name: str, errors_m: tuple[float, ...]
) -> None:
    run = outcomes[name]
    seen = [error_at_m(run, time_s) for time_s in (5.0, 10.0, 20.0, 60.0)]
    assert seen == pytest.approx(errors_m, abs=MILLIMETRE_M)


@pytest.mark.parametrize(
    ("name", "final", "end_m"),
    [
        ("paper_free", 0.0884, (-0.196, 0.731)),
        ("paper_singularity", 0.1417, (-0.115, 0.747)),
        ("paper_obstacle", 0.129, (-0.160, 0.739)),
    ],
)
def test_the_remote_arm_ends_as_far_from_singular_as_in_the_figures(
    outcomes: dict[str, Outcome], name: str, final: float, end_m: tuple[float, float]
) -> None:
    run = outcomes[name]
    assert run.measures["remote_manipulability_end"] == pytest.approx(final, rel=ONE_PERCENT)
    assert run.vector("remote_position")[-1] == pytest.approx(
        end_m, abs=2 * MILLIMETRE_M
    )  # at 1 mm of error still to go


@pytest.mark.parametrize(
    ("name", "nearest_m"),
    [("paper_free", 0.130), ("paper_singularity", 0.218), ("paper_obstacle", 0.199)],
)
def test_avoidance_keeps_the_midpoints_at_the_safe_radius(
    outcomes: dict[str, Outcome], name: str, nearest_m: float
) -> None:
    assert outcomes[name].measures["midpoint_distance_min_m"] == pytest.approx(
        nearest_m, abs=MILLIMETRE_M
    )


def test_either_sub_task_raises_the_index_and_speeds_up_convergence(
    outcomes: dict[str, Outcome],
) -> None:
    free = outcomes["paper_free"].measures
    for name in ("paper_singularity", "paper_obstacle"):
        run = outcomes[name].measures
        assert run["remote_manipulability_end"] > 1.4 * free["remote_manipulability_end"]
        assert run["settled_1_mm_s"] < 0.8 * free["settled_1_mm_s"]


@pytest.mark.parametrize("name", PAPER)
def test_torques_stay_small_and_the_sub_task_is_followed(
    outcomes: dict[str, Outcome], name: str
) -> None:
    run = outcomes[name]
    assert run.measures["remote_torque_max_nm"] < 0.26
    assert run.measures["sub_task_error_end_rad_s"] < 1e-5


@pytest.mark.parametrize(("name", "millimetre_s"), [("theorem_a", 29.7), ("theorem_b", 6.4)])
def test_sharper_certificates_allow_faster_gains(
    outcomes: dict[str, Outcome], name: str, millimetre_s: float
) -> None:
    assert outcomes[name].measures["settled_1_mm_s"] == pytest.approx(millimetre_s, rel=ONE_PERCENT)


def test_task_damping_is_thirty_times_faster(outcomes: dict[str, Outcome]) -> None:
    free, task = (outcomes[name].measures for name in ("paper_free", "theorem_b"))
    assert task["settled_1_mm_s"] < free["settled_1_mm_s"] / 30


@pytest.mark.parametrize("name", NAMES)
def test_the_null_space_motion_stays_in_the_null_space(
    outcomes: dict[str, Outcome], name: str
) -> None:
    run = outcomes[name].measures
    assert (run["null_space_speed_max_rad_s"] > 1e-3) == (name in PAPER and name != "paper_free")
    assert run["null_space_leak_m_s"] < 1e-12
