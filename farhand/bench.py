"""`farhand bench`."""

import json
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from experiments.benchmarks.figures import FULL, QUICK, Benchmark, BenchmarkError, Verdict
from experiments.benchmarks.page import (
    NOT_MEASURED,
    as_json,
    cells,
    markdown,
    notes,
    write_between_marks,
)
from experiments.benchmarks.suite import BENCHMARKS, Page, run
from farhand.console import ERR, EXIT_USER_ERROR, OUT, user_errors

_NAMES = ", ".join(benchmark.name for benchmark in BENCHMARKS)
_STYLES = {
    Verdict.FURTHER: "green",
    Verdict.REACHED: "green",
    Verdict.MISSED: "red",
    Verdict.STATED: "dim",
    NOT_MEASURED: "yellow",
}


def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="A few minutes in all rather than half an hour.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help=f"Only some; repeatable. One of {_NAMES}."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures into this file too.")
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option("--page", help="Write the table between the marks of this Markdown file too."),
    ] = None,
) -> None:
    """Measure what farhand costs beside what it cannot avoid, on this machine, in one run."""
    chosen = _chosen(only or [])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # what runs is ended
    words = ["farhand bench", *(["--quick"] if quick else [])]
    words += [f"--only {name}" for name in only or []]
    found = run(chosen, QUICK if quick else FULL, " ".join(words), _tell)
    with user_errors():
        if json_file is not None:
            text = json.dumps(as_json(found), indent=1, ensure_ascii=False, allow_nan=False)
            json_file.write_text(text + "\n", encoding="utf-8")
        if page is not None:
            _write_page(page, found)
    _print(found)


def _chosen(only: list[str]) -> list[Benchmark]:
    known = {benchmark.name: benchmark for benchmark in BENCHMARKS}
    unknown = [name for name in only if name not in known]
    if unknown:
        raise typer.BadParameter(f"there is no {', '.join(unknown)}; choose from {_NAMES}")
    return [known[name] for name in only] if only else list(BENCHMARKS)


def _tell(benchmark: Benchmark) -> None:
    ERR.print(f"{benchmark.name}: {benchmark.what} …", highlight=False, markup=False)


def _write_page(path: Path, found: Page) -> None:
    try:
        write_between_marks(path, markdown(found))
    except BenchmarkError as error:
        ERR.print(str(error), style="red", highlight=False, markup=False, soft_wrap=True)
        raise typer.Exit(EXIT_USER_ERROR) from None


def _print(found: Page) -> None:
    table = Table("against what", "p50 / p99 / p99.9", "judged", show_lines=True)
    for row in found.rows:
        what, against, ours, yardstick, ratio, judged, aim, verdict = map(escape, cells(row))
        table.add_row(
            f"[bold]{what}[/bold]\n{against}",
            f"{ours}\n{yardstick}\n[bold]{ratio}[/bold]" if ours else "",
            "\n".join(filter(None, (judged, aim, f"[{_STYLES[verdict]}]{verdict}[/]"))),
        )
    OUT.print(table)
    for note in notes(found):
        OUT.print(f"• {note}", highlight=False, markup=False)
    for name, value in found.machine.items():
        OUT.print(f"{name}: {value}", highlight=False, markup=False)
