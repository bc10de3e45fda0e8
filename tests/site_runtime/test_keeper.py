"""A keeper's thread, whose looks may fail."""

import time
from collections.abc import Callable

import pytest

from site_runtime.daemon_log import DaemonLog
from site_runtime.keeper import Keeper


class Clumsy(Keeper):
    """Fails as it is told to, and counts."""

    def __init__(self, fail: Callable[[], None], fail_safe: Callable[[], None]) -> None:
        super().__init__("thing", 0.005, DaemonLog("remote"))
        self.looks = 0
        self.failed = 0
        self._fail, self._fail_safe = fail, fail_safe

    def look(self) -> None:
        self.looks += 1
        self._fail()

    def look_failed(self) -> None:
        self.failed += 1
        self._fail_safe()


def well() -> None:
    return


def badly() -> None:
    raise KeyError("surprise")


def worse() -> None:
    raise RuntimeError("no safe side")


def looking(keeper: Clumsy, looks: int) -> None:
    end_s = time.monotonic() + 30.0
    with keeper:
        while keeper.looks < looks:
            assert time.monotonic() < end_s
            time.sleep(0.005)


def test_a_look_that_fails_is_told_once_and_the_next_one_comes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    keeper = Clumsy(badly, well)
    looking(keeper, 5)
    assert keeper.failed == keeper.looks
    said = capsys.readouterr().err
    assert said.count("keeping the thing failed, and goes on: KeyError: 'surprise'") == 1
    assert "test_keeper.py" in said


def test_nor_does_it_end_where_the_safe_side_cannot_be_reached(
    capsys: pytest.CaptureFixture[str],
) -> None:
    keeper = Clumsy(badly, worse)
    looking(keeper, 5)
    said = capsys.readouterr().err
    assert said.count("KeyError") == said.count("RuntimeError: no safe side") == 1


def test_looks_that_succeed_leave_the_rest_alone(capsys: pytest.CaptureFixture[str]) -> None:
    keeper = Clumsy(well, badly)
    looking(keeper, 3)
    assert keeper.failed == 0
    assert capsys.readouterr().err == ""
