"""`farhand reproduce`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from experiments.case import Case
from experiments.reproduction import reproduce as reproduce_studies
from experiments.studies import STUDIES
from farhand.console import ERR, OUT, user_errors

EXIT_STOPPED = 130  # as a shell says of SIGINT
_ALL = "all"


def reproduce(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="STUDY...",
            help="all, or some of: " + ", ".join(study.name for study in STUDIES) + ".",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the report, its figures and the runs.")
    ] = Path("reproduction"),
    workers: Annotated[
        int | None, typer.Option("--workers", help="Processes; one a core unless given.", min=1)
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            help="Address of a dask scheduler to run on, e.g. tcp://A.example:8786; it and its "
            "workers have this same farhand installed.",
        ),
    ] = None,
) -> None:
    """Reproduce the paper: its figures, theorems and remarks, as one report.

    Stopped and started again, it goes on with the runs that are missing.
    """
    unknown = sorted(set(names) - {study.name for study in STUDIES} - {_ALL})
    if unknown:
        known = ", ".join([_ALL, *(study.name for study in STUDIES)])
        raise typer.BadParameter(f"there is no study {', '.join(unknown)}; choose from {known}")
    studies = [study for study in STUDIES if _ALL in names or study.name in names]
    cases = {case.name for study in studies for case in study.cases}
    with (
        user_errors(),
        Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=ERR,
        ) as bar,
    ):
        task = bar.add_task("runs", total=len(cases))

        def done(case: Case) -> None:
            bar.update(task, advance=1, description=case.name)

        command = _ALL if _ALL in names else " ".join(study.name for study in studies)
        try:
            reproduce_studies(
                studies, out, command=command, workers=workers, scheduler=scheduler, done=done
            )
        except KeyboardInterrupt:
            ERR.print("stopped; started again, it goes on with the runs that are missing")
            raise typer.Exit(EXIT_STOPPED) from None
    OUT.print(f"report: {out / 'report.md'} and {out / 'report.html'}")
