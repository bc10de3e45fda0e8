"""What studies say, as Markdown and as a web page."""

from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from math import nan
from pathlib import Path

import pytest

from experiments import reproduction
from experiments.case import Case, Outcome
from experiments.report import Claim, Figure, Section, Table, Verdict, write_report
from experiments.reproduction import reproduce
from experiments.study import Study

CLAIMS = (
    Claim("Fig. 9", "|x| stays <b>small</b>", "|x| ≤ 1 m", Verdict.HOLDS),
    Claim("Fig. 9", "it rests", "0 m/s", Verdict.HOLDS),
    Claim("(9)", "it turns", "only for a < 2", Verdict.CONDITIONAL),
    Claim("(9)", "it flies", "a & b", Verdict.FAILS),
)
TABLE = Table("All runs:", ("run", "‖x‖ | m"), (("a", "1"), ("`b | c`", "two\nlines")))
SECTIONS = (
    Section("Fig. 9", "As *drawn*.", CLAIMS[:2], (TABLE,), (Figure("figure_9.png", "Fig. 9"),)),
    Section("Equation <9>", "As <script>alert(1)</script> printed.", CLAIMS[2:]),
    Section("Last", "Nothing claimed."),
)
VOID = {"meta", "img", "link", "br", "hr"}


@dataclass
class Page(HTMLParser):
    """The page's tables, texts by tag, images; an error for tags that do not match."""

    tables: list[list[list[str]]] = field(default_factory=list)
    texts: dict[str, list[str]] = field(default_factory=dict)
    images: list[dict[str, str | None]] = field(default_factory=list)
    open: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.images.append(dict(attrs))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in {"td", "th"}:
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        assert tag in VOID or self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        for tag in self.open:
            self.texts[tag][-1] += data
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data


@pytest.fixture
def page(tmp_path: Path) -> Page:
    write_report(tmp_path, "Fig. 9 & <co>", "An introduction.", SECTIONS)
    parsed = Page()
    parsed.feed((tmp_path / "report.html").read_text(encoding="utf-8"))
    parsed.close()
    assert parsed.open == []
    return parsed


@pytest.fixture
def markdown(tmp_path: Path) -> str:
    write_report(tmp_path, "Title", "An introduction.", SECTIONS)
    return (tmp_path / "report.md").read_text(encoding="utf-8")


def test_verdicts_are_counted(markdown: str, page: Page) -> None:
    counts = "4 claims: 2 hold, 1 hold under a condition, 1 do not hold."
    assert counts in markdown
    assert counts in page.texts["p"]


def test_without_claims_there_is_no_table_of_them(tmp_path: Path) -> None:
    write_report(tmp_path, "Title", "", SECTIONS[2:])
    assert "laims" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_the_parts_stand_in_their_order(page: Page) -> None:
    assert page.texts["h1"] == ["Fig. 9 & <co>"]
    assert page.texts["h2"] == ["Claims and verdicts", "Fig. 9", "Equation <9>", "Last"]
    assert page.texts["title"] == ["Fig. 9 & <co>"]
    assert page.texts["p"][0] == "An introduction."


def test_each_row_of_each_table_is_on_the_page(page: Page) -> None:
    claims, table = page.tables
    assert claims == [
        ["claim", "where", "our numbers", "verdict"],
        *([c.claim, c.source, c.numbers, c.verdict.value] for c in CLAIMS),
    ]
    assert table == [["run", "‖x‖ | m"], ["a", "1"], ["b | c", "two lines"]]
    assert page.texts["strong"] == [c.verdict.value for c in CLAIMS]


def test_pipes_in_cells_are_escaped(markdown: str) -> None:
    lines = markdown.splitlines()
    assert r"| \|x\| stays <b>small</b> | Fig. 9 | \|x\| ≤ 1 m | **holds** |" in lines
    assert r"| `b \| c` | two lines |" in lines


def test_markup_of_the_text_is_set_and_html_is_not(page: Page) -> None:
    assert "drawn" in page.texts["em"]
    assert "script" not in page.texts
    assert "b" not in page.texts
    assert "As <script>alert(1)</script> printed." in page.texts["p"]


def test_figures_are_linked(markdown: str, page: Page) -> None:
    assert "![Fig. 9](figure_9.png)" in markdown
    assert page.images == [{"src": "figure_9.png", "alt": "Fig. 9"}]
    assert "Fig. 9" in page.texts["em"]


def test_the_same_findings_give_the_same_bytes(tmp_path: Path) -> None:
    pages = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        write_report(folder, "Title", "An introduction.", SECTIONS)
        pages.append([(folder / f"report.{end}").read_bytes() for end in ("md", "html")])
    assert pages[0] == pages[1]


@pytest.mark.parametrize(
    ("as_stated", "under_the_condition", "verdict"),
    [
        (True, False, Verdict.HOLDS),
        (True, True, Verdict.HOLDS),
        (False, True, Verdict.CONDITIONAL),
        (False, False, Verdict.FAILS),
    ],
)
def test_a_verdict_is_the_best_that_is_true(
    as_stated: bool, under_the_condition: bool, verdict: Verdict
) -> None:
    assert Verdict.only_if(as_stated, under_the_condition) is verdict
    assert Verdict.of(as_stated) is (Verdict.HOLDS if as_stated else Verdict.FAILS)


# The report of a whole reproduction: the studies' sections, and a row of invariants a run.


def invariants(
    outcomes: list[Outcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[list[str]]:
    found = {outcome.case.name: outcome for outcome in outcomes}
    monkeypatch.setattr(reproduction, "run_cases", lambda *_, **__: found)
    study = Study("little", "", (), lambda outcomes, _: Section("Little", ", ".join(outcomes)))
    reproduce([study], tmp_path, command="little")
    page = Page()
    page.feed((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.texts["h2"] == ["Little", "Invariants"]
    assert page.texts["code"] == ["farhand reproduce little\n"]
    assert ", ".join(found) in page.texts["p"]
    return page.tables[-1]


def test_each_run_has_a_row_of_invariants(
    short: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = {
        **short.measures,
        "error_end_m": 1.2e-4,
        "null_space_leak_m_s": 3e-16,
        "energy_start_j": 2.0,
        "energy_rise_j": 1e-6,
        "remote_coupling_force_max_n": 7.0,
    }
    told = replace(short, measures=figures)
    without = {name: value for name, value in figures.items() if not name.startswith("energy")}
    silent = replace(
        short,
        case=Case("silent", "theorems.toml", 0.4),
        measures={**without, "round_trip_max_s": nan},
        failures=("remote: lost",),
    )
    head, first, second = invariants([told, silent], tmp_path, monkeypatch)
    assert len(head) == len(first) == len(second)
    row = dict(zip(head, first, strict=True))
    assert row["run"] == "short"
    assert row["time [s]"] == "0.4"
    assert row["TTE [m]"] == "0.572 → 1.2e-04"
    assert row["T measured / certified [s]"] == f"{figures['round_trip_max_s']:.3f} / 0.602"
    assert row["max ‖Jζ‖ [m/s]"] == "3e-16"
    assert row["max ‖ΩP‖∞ [N]"] == "7.00"
    assert row["rise of V / V(0)"] == "5e-07"
    row = dict(zip(head, second, strict=True))
    assert row["run"] == "silent (failed)"
    assert row["T measured / certified [s]"] == "– / 0.602"
    assert row["rise of V / V(0)"] == ""


def test_a_run_that_failed_at_once_has_a_row_too(
    failed_at_once: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head, row = invariants([failed_at_once], tmp_path, monkeypatch)
    assert row == ["straight (failed)", *[""] * (len(head) - 1)]
