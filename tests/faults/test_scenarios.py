"""Each fault of the table once, on real daemons; the table says what each site must do."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.faults import namespace, wall_clock
from tests.faults.scenarios import SCENARIOS
from tests.faults.stage import Scenario, Setting, Stage, opened

pytestmark = pytest.mark.processes

TRIES = 3  # a machine that stalls makes sites hold, and lets them miss a bound


class Stages:
    """The stage in use; another setting closes it."""

    def __init__(self, folder: pytest.TempPathFactory) -> None:
        self._folders = folder
        self._open = ExitStack()
        self._setting: Setting | None = None
        self._stage: Stage | None = None

    def of(self, setting: Setting) -> Stage:
        """Return a stage of this setting, in use before or not."""
        if self._stage is None or setting is not self._setting:
            self.close()
            folder: Path = self._folders.mktemp("faults")
            self._stage = self._open.enter_context(opened(setting, folder))
            self._setting = setting
        return self._stage

    def close(self) -> None:
        """End its daemons."""
        self._stage = None
        self._open.close()


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stages]:
    stages = Stages(tmp_path_factory)
    yield stages
    stages.close()


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_sites_stay_safe_and_come_back(stages: Stages, scenario: Scenario) -> None:
    if scenario.setting is Setting.NETWORK and namespace.refusal() is not None:
        pytest.skip(str(namespace.refusal()))
    if "wall clock" in scenario.name and wall_clock.COMPILER is None:
        pytest.skip("no C compiler `cc`")
    seen: list[str] = []
    for _ in range(TRIES):
        outcome = stages.of(scenario.setting).play(scenario)
        assert not outcome.violations, "\n".join(outcome.violations)
        if not outcome.deviations:
            return
        seen += outcome.deviations
    pytest.fail("\n".join(seen))
