"""`farhand bench`: what is chosen, measured, printed and written."""

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from experiments.benchmarks.figures import (
    FULL,
    QUICK,
    Benchmark,
    BenchmarkError,
    Effort,
    Goal,
    Row,
    Spread,
)
from experiments.benchmarks.page import BEGIN, END
from farhand import bench
from farhand.__main__ import app

ONE = Spread.of([1.0, 2.0])


@pytest.fixture
def efforts(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, Effort]]]:
    """Two benchmarks in place of all, and what they were asked for."""
    asked: list[tuple[str, Effort]] = []

    def good(effort: Effort) -> Iterator[Row]:
        asked.append(("good", effort))
        yield Row("a [good] one", "a yardstick", "µs", ONE, ONE, (Goal("p50", 1.0, 2.0, 0.5),))

    def absent(effort: Effort) -> Iterator[Row]:
        asked.append(("absent", effort))
        raise BenchmarkError("needs mujoco")
        yield

    some = (Benchmark("good", "a good one", good), Benchmark("absent", "an absent one", absent))
    monkeypatch.setattr(bench, "BENCHMARKS", some)
    before = signal.getsignal(signal.SIGTERM)
    yield asked
    signal.signal(signal.SIGTERM, before)


def test_one_page_is_printed_and_written(efforts: list, tmp_path: Path) -> None:
    page, figures = tmp_path / "page.md", tmp_path / "figures.json"
    page.write_text(f"# Page\n{BEGIN}\n{END}\n", encoding="utf-8")
    done = CliRunner().invoke(
        app, ["bench", "--json", str(figures), "--page", str(page)], env={"COLUMNS": "120"}
    )
    assert done.exit_code == 0, done.output
    assert efforts == [("good", FULL), ("absent", FULL)]
    for words in ("a [good] one", "a yardstick", "needs mujoco", "not measured", "processor"):
        assert words in done.output
    assert "| a [good] one | a yardstick |" in page.read_text(encoding="utf-8")
    told = json.loads(figures.read_text(encoding="utf-8"))
    assert told["command"] == "farhand bench"
    assert [row["verdict"] for row in told["rows"]] == ["reached", "not measured"]


def test_some_may_be_chosen_and_be_quick(efforts: list) -> None:
    done = CliRunner().invoke(app, ["bench", "--quick", "--only", "good"])
    assert done.exit_code == 0, done.output
    assert efforts == [("good", QUICK)]


def test_a_benchmark_that_is_not_there_is_named_with_those_that_are(efforts: list) -> None:
    done = CliRunner().invoke(app, ["bench", "--only", "bad"], env={"COLUMNS": "200"})
    assert done.exit_code == 2
    assert "there is no bad" in done.output
    assert "tick" in done.output
    assert efforts == []


def test_a_page_without_marks_is_a_users_error(efforts: list, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n", encoding="utf-8")
    done = CliRunner().invoke(app, ["bench", "--only", "good", "--page", str(page)])
    assert done.exit_code == 2
    assert "there is no <!-- begin" in done.output
    assert page.read_text(encoding="utf-8") == "nothing\n"
