"""The page as Markdown between its marks, and as JSON."""

import json
from math import nan
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from experiments.benchmarks.figures import (
    BRIEF,
    Benchmark,
    BenchmarkError,
    Goal,
    Row,
    Spread,
    Unmeasured,
)
from experiments.benchmarks.page import (
    BEGIN,
    END,
    HEAD,
    as_json,
    cells,
    markdown,
    write_between_marks,
)
from experiments.benchmarks.suite import BENCHMARKS, Page, run

ROOT = Path(__file__).parents[3]
ROW = Row(
    "a tick | cold",
    "the floor",
    "µs",
    Spread(300.0, 600.04, 1.2345, 1000),
    Spread(100.0, 0.0, 2.0, 900),
    (Goal("p50", 3.0, 2.5, 1.5), Goal("p99", nan, 2.5, 1.5)),
    ("12 ticks missed",),
)
PAGE = Page(
    "farhand bench",
    {"processor": "one", "load": "0.1"},
    (ROW, Unmeasured("the rest", "needs mujoco")),
    90.0,
)


def test_a_line_tells_figure_yardstick_ratio_goal_and_verdict() -> None:
    assert cells(ROW) == (
        "a tick | cold",
        "the floor",
        "300 / 600 / 1.23 µs",
        "100 / 0 / 2 µs",
        "3 / – / 0.617",
        "p50: 3; p99: –",
        "≤ 2.5, 1.5",
        "not reached",
    )


def test_what_is_not_measured_says_why() -> None:
    told = cells(PAGE.rows[1])
    assert len(told) == len(HEAD)
    assert told[:2] == ("the rest", "needs mujoco")
    assert told[-1] == "not measured"


def test_markdown_holds_every_line_the_notes_and_the_machine() -> None:
    html = MarkdownIt("commonmark").enable("table").render(markdown(PAGE))
    assert html.count("<table>") == 2
    assert html.count("<tr>") == 1 + len(PAGE.rows) + 1 + len(PAGE.machine)
    assert "<td>a tick | cold</td>" in html
    assert "1000 samples against 900; 12 ticks missed" in html
    assert "<td>needs mujoco</td>" in html


def test_json_holds_the_same_and_only_what_json_can() -> None:
    told = json.loads(json.dumps(as_json(PAGE), allow_nan=False))
    first, second = told["rows"]
    assert first["ours"] == {"p50": 300.0, "p99": 600.04, "p99.9": 1.2345, "samples": 1000}
    assert first["ratio"] == [3.0, None, pytest.approx(0.61725)]
    assert first["goals"][1]["value"] is None
    assert first["verdict"] == "not reached"
    assert second == {"what": "the rest", "verdict": "not measured", "reason": "needs mujoco"}
    assert told["machine"] == PAGE.machine


def test_only_what_is_between_the_marks_is_replaced(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n", encoding="utf-8")
    write_between_marks(page, "new\n")
    assert page.read_text(encoding="utf-8") == f"before\n{BEGIN}\nnew\n{END}\nafter\n"


@pytest.mark.parametrize("text", ["", BEGIN, END, f"{END}\n{BEGIN}"])
def test_a_page_without_its_marks_is_left_alone(tmp_path: Path, text: str) -> None:
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    with pytest.raises(BenchmarkError, match="there is no"):
        write_between_marks(page, "new\n")
    assert page.read_text(encoding="utf-8") == text


def test_the_documents_page_has_its_marks_and_names_every_benchmark() -> None:
    text = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    assert text.count(BEGIN) == text.count(END) == 1
    for benchmark in BENCHMARKS:
        assert f"`{benchmark.name}`" in text


def test_a_run_tells_of_every_benchmark_also_of_those_that_fail(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def half(_: object) -> object:
        yield ROW
        raise BenchmarkError("no cyclictest")

    def broken(_: object) -> object:
        raise ZeroDivisionError("by nothing")
        yield

    begun = []
    some = (Benchmark("half", "a half", half), Benchmark("broken", "a break", broken))
    page = run(some, BRIEF, "bench", begun.append)
    assert tuple(begun) == some
    assert page.rows == (
        ROW,
        Unmeasured("a half", "no cyclictest"),
        Unmeasured("a break", "failed: ZeroDivisionError: by nothing"),
    )
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert {"processor", "load", "privileges", "kernel", "governor", "cores"} <= set(page.machine)
