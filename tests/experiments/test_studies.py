"""The studies that come with farhand, and the command that runs them."""

import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from experiments.case import Case
from experiments.studies import STUDIES
from experiments.study import Study
from farhand.__main__ import app

ROOT = Path(__file__).resolve().parents[2]
REPORT = ROOT / "docs" / "reproduction" / "report.md"
VERDICT = re.compile(r"\| (?P<claim>.*) \| (?P<where>.*) \| .* \| \*\*(?P<verdict>[\w ]+)\*\* \|")
# Each may be asked for by several studies, as one and the same.
CASES = {case.name: case for study in STUDIES for case in study.cases}


@pytest.mark.parametrize("case", CASES.values(), ids=lambda case: case.name)
def test_a_case_is_a_valid_session(case: Case) -> None:
    session = case.session()
    assert session.name == Path(case.session_file).stem
    assert len(case.fingerprint()) == 32
    assert session.loop.rate_hz % case.trace_hz == 0
    for key in [key for key, value in case.changes.items() if value is None]:
        kept = replace(case, changes={k: v for k, v in case.changes.items() if k != key})
        assert kept.session().digest != session.digest, f"there is no {key} to remove"


def test_names_are_of_one_thing_each() -> None:
    studies = Counter(study.name for study in STUDIES)
    assert set(studies.values()) == {1}
    assert "all" not in studies
    for study in STUDIES:
        assert study.cases
        for case in study.cases:
            assert case == CASES[case.name]
            assert re.fullmatch(r"[\w.]+", case.name)  # it names a file


def test_different_cases_are_different_runs() -> None:
    assert len({case.fingerprint() for case in CASES.values()}) == len(CASES)


def test_each_session_of_the_paper_is_in_a_study() -> None:
    used = {case.session_file for case in CASES.values()}
    there = {file.name for file in (ROOT / "experiments").glob("*.toml")}
    assert used <= there
    assert there - used == {"demo.toml", "bench_fake.toml"}


def farhand(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["reproduce", *arguments], terminal_width=200)
    return result.exit_code, " ".join(re.sub("[│╭╮╰╯─]", " ", result.output).split())


def test_a_study_that_is_not_there_is_answered_with_those_that_are() -> None:
    code, output = farhand("figure_2", "figure_9", "table_1")
    assert code == 2
    listed = ", ".join(["all", *(study.name for study in STUDIES)])
    assert f"there is no study figure_9, table_1; choose from {listed}" in output


def test_help_lists_the_studies() -> None:
    code, output = farhand("--help")
    assert code == 0
    assert "all, or some of: " + ", ".join(study.name for study in STUDIES) in output


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["all"], [study.name for study in STUDIES]),
        (["figure_5", "figure_2"], ["figure_2", "figure_5"]),  # in the report's order
        (["figure_5", "all"], [study.name for study in STUDIES]),
    ],
)
def test_the_studies_named_are_run(
    names: list[str], expected: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran: list[tuple[list[str], Path, str]] = []

    def reproduce(studies: list[Study], folder: Path, *, command: str, **_: object) -> None:
        ran.append(([study.name for study in studies], folder, command))

    monkeypatch.setattr("farhand.reproduce.reproduce_studies", reproduce)
    code, _ = farhand(*names, "--out", str(tmp_path))
    assert code == 0
    command = "all" if "all" in names else " ".join(expected)
    assert ran == [(expected, tmp_path, command)]


@pytest.fixture(scope="module")
def figure_5(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `farhand reproduce figure_5`, run as a person does."""
    out = tmp_path_factory.mktemp("figure_5")
    done = subprocess.run(
        [sys.executable, "-m", "farhand", "reproduce", "figure_5", "--out", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "3/3" in done.stderr
    assert "report.md" in done.stdout
    return out


def verdicts(report: Path) -> dict[str, str]:
    """Verdicts by claim."""
    text = report.read_text(encoding="utf-8")
    return {match["claim"]: match["verdict"] for match in VERDICT.finditer(text)}


def test_figure_5_is_reproduced_by_the_command(figure_5: Path) -> None:
    found = verdicts(figure_5 / "report.md")
    assert len(found) == 2
    assert set(found.values()) == {"holds"}
    assert imread(figure_5 / "figure_5.png").shape[:2] == (666, 1440)
    assert {file.name for file in (figure_5 / "runs").iterdir()} == {
        f"figure_5_{run}.{end}"
        for run in ("without", "with", "bounded")
        for end in ("parquet", "seal")
    }
    assert "farhand reproduce figure_5" in (figure_5 / "report.html").read_text(encoding="utf-8")


@pytest.mark.skipif(not REPORT.exists(), reason="docs/reproduction/report.md is not there yet")
def test_figure_5_s_verdicts_are_those_of_the_report_that_is_shipped(figure_5: Path) -> None:
    found, shipped = verdicts(figure_5 / "report.md"), verdicts(REPORT)
    assert found.items() <= shipped.items()
