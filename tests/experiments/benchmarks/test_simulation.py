"""The yardstick of `farhand simulate` computes the same, and both are measured."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from experiments.benchmarks.mujoco_loop import run
from experiments.benchmarks.simulation import SimulationFigures, simulation_figures
from experiments.simulation import Simulation
from site_runtime.session import load_session

EXPERIMENTS = Path(__file__).parents[3] / "experiments"

# The same formula step by step: rounding alone is between them. Measured: 4e-15 rad, 4e-15 N·m.
PATH = 1e-11


@pytest.mark.parametrize(
    ("name", "duration_s"),
    [("paper_free", 4.0), ("figure_2", 6.0)],  # where a hand pushes from 5 s on
)
def test_the_hand_written_loop_moves_along_farhands_path(name: str, duration_s: float) -> None:
    file = EXPERIMENTS / f"{name}.toml"
    simulated = Simulation(load_session(file)).run(duration_s)
    by_hand = run(tomllib.loads(file.read_text(encoding="utf-8")), duration_s)
    for arm, rows in zip(by_hand, (simulated.local, simulated.remote), strict=True):
        assert len(rows) == len(arm.q_samples) == duration_s * 1000 + 1
        assert np.ptp(rows["q"], axis=0).min() > 0.05  # every joint moved
        np.testing.assert_allclose(arm.q_samples, rows["q"], 0.0, PATH)
        np.testing.assert_allclose(arm.q_dot_samples, rows["q_dot"], 0.0, PATH)
        np.testing.assert_allclose(arm.torque_samples, rows["torque_nm"], 0.0, PATH)
        np.testing.assert_allclose(arm.X_samples, rows["position_m"], 0.0, PATH)


@pytest.mark.parametrize(
    "change", [{"mass": "rod"}, {"gravity_m_s2": [0.0, -9.81]}, {"kind": "urdf"}]
)
def test_it_says_which_arms_it_cannot_move(change: dict[str, object]) -> None:
    session = tomllib.loads((EXPERIMENTS / "paper_free.toml").read_text(encoding="utf-8"))
    session["remote"]["robot"] |= change
    with pytest.raises(ValueError, match="is not a planar arm of point masses"):
        run(session, 0.01)


def test_both_are_measured_on_one_core_and_the_cores_given_back() -> None:
    cores = os.sched_getaffinity(0)
    figures = simulation_figures(EXPERIMENTS / "paper_free.toml", duration_s=1.0, turns=1)
    assert os.sched_getaffinity(0) == cores
    assert figures.session == "paper_free"
    for measured_s in (figures.farhand_s, figures.by_hand_s):
        assert len(measured_s) == 1
    assert 0.0 < figures.times_real_time < figures.by_hand_times_real_time * 10.0
    assert figures.farhand_start_s[0] > 0.0
    assert figures.by_hand_start_s[0] > 0.0


def test_figures_are_medians_without_the_start() -> None:
    figures = SimulationFigures(
        "any", 10.001, (4.0, 3.0, 9.0), (2.0, 2.0, 2.0), (1.0, 1.0, 1.0), (1.0, 1.5, 1.0)
    )
    assert figures.farhand_s_per_s == pytest.approx((0.3, 0.2, 0.8))
    assert figures.by_hand_s_per_s == pytest.approx((0.1, 0.05, 0.1))
    assert figures.ratio == pytest.approx(4.0)
    assert figures.times_real_time == pytest.approx(10.001 / 4.0)
    assert figures.by_hand_times_real_time == pytest.approx(10.001 / 2.0)


def test_a_process_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"absent\.toml"):
        simulation_figures(tmp_path / "absent.toml", duration_s=0.01, turns=1)
