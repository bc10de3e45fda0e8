"""A short run of the demo, simulated once."""

from pathlib import Path

import pytest

from experiments.simulation import Run, Simulation
from site_runtime.session import Session, load_session

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"


@pytest.fixture(scope="session")
def demo_session() -> Session:
    return load_session(DEMO)


@pytest.fixture(scope="session")
def demo_run(demo_session: Session) -> Run:
    run = Simulation(demo_session).run(2.0)
    for rows in (run.local, run.remote):
        rows["clock_uncertainty_ns"] = -1  # so that a test may put the clocks apart
    return run
