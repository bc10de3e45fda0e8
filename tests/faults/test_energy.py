"""The soak's eye on the energy: quiet where the proof holds, loud where rows say otherwise."""

from pathlib import Path

import numpy as np
import pytest

from experiments.simulation import Run, Simulation
from site_runtime.session import Session, load_session
from tests.faults.energy import energy_rises
from tests.faults.session import pulses, write_session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    path: Path = tmp_path_factory.mktemp("energy") / "session.toml"
    return load_session(write_session(path, lease_s=1.0, operator=pulses(2, every_s=4.0)))


@pytest.fixture(scope="module")
def run(session: Session) -> Run:
    return Simulation(session).run(8.0)


def test_free_motion_of_certified_gains_is_followed_and_found_sound(
    session: Session, run: Run
) -> None:
    checked, rises = energy_rises(session, run.local, run.remote)
    assert checked == 2  # before the first push, and after it
    assert rises == []


@pytest.mark.parametrize("name", ["q_dot", "position_m"])
def test_motion_that_nobody_caused_is_a_rise(session: Session, run: Run, name: str) -> None:
    remote = run.remote.copy()
    after = remote["time_ns"] > 5_000_000_000
    remote[name][after] += 0.05 if name == "position_m" else 0.5
    _, rises = energy_rises(session, run.local, remote)
    assert len(rises) == 1


def test_pushes_returns_and_loops_beyond_the_certificate_are_left_out(
    session: Session, run: Run
) -> None:
    assert np.isfinite(run.local["loop_bound_s"]).all()
    for name, value in (
        ("external_force_n", 1.0),
        ("loop_bound_s", 1.0),
        ("force_share", 0.9),
        ("cut", 1),
        ("state", 4),
    ):
        local = run.local.copy()
        local[name] = value
        assert energy_rises(session, local, run.remote) == (0, []), name
