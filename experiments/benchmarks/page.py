"""The page of figures: as Markdown between two marks of a document, and as JSON."""

from collections.abc import Iterable, Iterator
from math import isfinite
from pathlib import Path
from typing import Any

from experiments.benchmarks.figures import BenchmarkError, Goal, Row, Spread, Unmeasured
from experiments.benchmarks.suite import Page

HEAD = ("what", "against", "ours", "yardstick", "ratio", "judged", "reach, then", "verdict")
BEGIN = "<!-- begin: written by farhand bench -->"
END = "<!-- end: written by farhand bench -->"
NOT_MEASURED = "not measured"


def cells(row: Row | Unmeasured) -> tuple[str, ...]:
    """Return the cells of a line, in the order of `HEAD`."""
    if isinstance(row, Unmeasured):
        return (row.what, row.reason, "", "", "", "", "", NOT_MEASURED)
    return (
        row.what,
        row.against,
        f"{_percentiles(row.ours.percentiles)} {row.unit}",
        f"{_percentiles(row.yardstick.percentiles)} {row.unit}",
        _percentiles(row.ours.over(row.yardstick)),
        "; ".join(f"{goal.text}: {_number(goal.value)}" for goal in row.goals),
        "; ".join(dict.fromkeys(_aim(goal) for goal in row.goals)),
        row.verdict.value,
    )


def notes(page: Page) -> Iterator[str]:
    """Yield what is to be said of each line: how many samples, and what else was seen."""
    for row in page.rows:
        if isinstance(row, Row):
            counts = f"{row.ours.count} samples against {row.yardstick.count}"
            yield f"{row.what}, {row.against}: " + "; ".join((counts, *row.notes))


def markdown(page: Page) -> str:
    """Return the page as Markdown."""
    lines = [
        f"Measured by `{page.command}` in {page.took_s / 60:.0f} minutes. "
        "Ours, yardstick and their ratio are p50 / p99 / p99.9 of samples taken in turns.",
        "",
        _line(HEAD),
        _line("---" for _ in HEAD),
        *(_line(cells(row)) for row in page.rows),
        "",
        *(f"* {note}" for note in notes(page)),
        "",
        "| the machine | |",
        "|---|---|",
        *(_line(pair) for pair in page.machine.items()),
    ]
    return "\n".join(lines) + "\n"


def as_json(page: Page) -> dict[str, Any]:
    """Return the page as what JSON can hold; numbers that are not finite are null."""
    return {
        "command": page.command,
        "machine": page.machine,
        "took_s": page.took_s,
        "rows": [_json_row(row) for row in page.rows],
    }


def write_between_marks(path: Path, text: str) -> None:
    """Put a text between the marks of a document; BenchmarkError if they are not there."""
    before, begin, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise BenchmarkError(f"{path}: there is no {BEGIN} … {END}")
    path.write_text(f"{before}{BEGIN}\n{text}{END}{after}", encoding="utf-8")


def _json_row(row: Row | Unmeasured) -> dict[str, Any]:
    if isinstance(row, Unmeasured):
        return {"what": row.what, "verdict": NOT_MEASURED, "reason": row.reason}
    return {
        "what": row.what,
        "against": row.against,
        "unit": row.unit,
        "ours": _json_spread(row.ours),
        "yardstick": _json_spread(row.yardstick),
        "ratio": [_finite(ratio) for ratio in row.ours.over(row.yardstick)],
        "goals": [
            {
                "text": goal.text,
                "value": _finite(goal.value),
                "at_least": goal.at_least,
                "reach": goal.reach,
                "then": goal.then,
                "verdict": goal.verdict.value,
            }
            for goal in row.goals
        ],
        "verdict": row.verdict.value,
        "notes": list(row.notes),
    }


def _json_spread(spread: Spread) -> dict[str, Any]:
    p50, p99, p999 = map(_finite, spread.percentiles)
    return {"p50": p50, "p99": p99, "p99.9": p999, "samples": spread.count}


def _aim(goal: Goal) -> str:
    sign = "≥" if goal.at_least else "≤"
    then = "" if goal.then == goal.reach else f", {goal.then:g}"
    return f"{sign} {goal.reach:g}{then}"


def _line(parts: Iterable[str]) -> str:
    escaped = (part.replace("|", r"\|") for part in parts)
    return f"| {' | '.join(escaped)} |"


def _percentiles(values: tuple[float, ...]) -> str:
    return " / ".join(map(_number, values))


def _number(value: float) -> str:
    if not isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
