"""What studies say: claims with their numbers and verdicts, tables, figures; Markdown and HTML."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from html import escape
from pathlib import Path

from markdown_it import MarkdownIt


class Verdict(StrEnum):
    """What became of a claim."""

    HOLDS = "holds"
    CONDITIONAL = "holds under a condition"
    FAILS = "does not hold"

    @classmethod
    def of(cls, holds: bool) -> "Verdict":
        """Return HOLDS or FAILS."""
        return cls.HOLDS if holds else cls.FAILS

    @classmethod
    def only_if(cls, as_stated: bool, under_the_condition: bool) -> "Verdict":
        """Return HOLDS as stated, else CONDITIONAL under the condition, else FAILS."""
        if as_stated:
            return cls.HOLDS
        return cls.CONDITIONAL if under_the_condition else cls.FAILS


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim of the paper, or of ours beside it; where it stands; our numbers; the verdict."""

    source: str
    claim: str
    numbers: str
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class Table:
    """A table; its cells are Markdown."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Figure:
    """A PNG file beside the report."""

    file: str
    caption: str


@dataclass(frozen=True, slots=True)
class Section:
    """What one study found, in Markdown."""

    title: str
    text: str
    claims: tuple[Claim, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


def write_report(folder: Path, title: str, introduction: str, sections: Sequence[Section]) -> None:
    """Write report.md and report.html into a folder."""
    text = "\n".join(_report(title, introduction, sections))
    (folder / "report.md").write_text(text, encoding="utf-8")
    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    page = _PAGE.format(title=escape(title), body=body)
    (folder / "report.html").write_text(page, encoding="utf-8")


def _report(title: str, introduction: str, sections: Sequence[Section]) -> Iterator[str]:
    yield f"# {title}\n"
    yield f"{introduction}\n"
    claims = [claim for section in sections for claim in section.claims]
    if claims:
        yield "## Claims and verdicts\n"
        counts = (f"{sum(c.verdict is v for c in claims)} {_COUNTED[v]}" for v in Verdict)
        yield f"{len(claims)} claims: {', '.join(counts)}.\n"
        yield from _table(_claims_table(claims))
    for section in sections:
        yield f"## {section.title}\n"
        yield f"{section.text}\n"
        for figure in section.figures:
            yield f"![{figure.caption}]({figure.file})\n"
            yield f"*{figure.caption}*\n"
        for table in section.tables:
            yield f"{table.caption}\n"
            yield from _table(table)


def _claims_table(claims: Sequence[Claim]) -> Table:
    return Table(
        "",
        ("claim", "where", "our numbers", "verdict"),
        tuple((c.claim, c.source, c.numbers, f"**{c.verdict}**") for c in claims),
    )


def _table(table: Table) -> Iterator[str]:
    for row in (table.head, ("---",) * len(table.head), *table.rows):
        yield "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |"
    yield ""


_COUNTED = {
    Verdict.HOLDS: "hold",
    Verdict.CONDITIONAL: "hold under a condition",
    Verdict.FAILS: "do not hold",
}

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222;
       font: 16px/1.5 system-ui, sans-serif; }}
table {{ border-collapse: collapse; font-size: 0.9rem; display: block; overflow-x: auto; }}
th, td {{ border: 1px solid #ccc; padding: 0.3rem 0.6rem; text-align: left; vertical-align: top; }}
th {{ background: #f4f4f4; }}
img {{ max-width: 100%; }}
</style>
<body>
{body}</body>
</html>
"""
