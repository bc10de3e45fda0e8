from pathlib import Path

import pytest

from experiments.case import Case, Outcome, read_outcome, run_case


@pytest.fixture(scope="session")
def failed_at_once(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """A run that fails in its first tick: in a singular pose the paper's projector has no value."""
    straight = {"remote.device.initial_position_rad": [0.0, 0.0, 0.0]}
    case = Case("straight", "figure_2.toml", 0.3, straight, energy_window_s=(0.2, 0.2))
    return _outcome(case, tmp_path_factory.mktemp("failed"))


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """A fraction of a second of Theorem 1's session, with its energy."""
    case = Case("short", "theorems.toml", 0.4, energy_window_s=(0.2, 0.2))
    return _outcome(case, tmp_path_factory.mktemp("short"))


def _outcome(case: Case, folder: Path) -> Outcome:
    file = folder / f"{case.name}.parquet"
    file.write_bytes(run_case(case))
    return read_outcome(case, file)
