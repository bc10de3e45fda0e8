"""`farhand plot`: a recording, or a result file, as one picture."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from experiments.recording_figure import PANELS, SiteTrace, recording_figure
from farhand.console import OUT, user_errors
from farhand.recordings import Recordings, TakeNumber
from site_runtime.supervisor import State
from telemetry.result_file import Result, column_names, read_result
from telemetry.rows import COLUMNS, MAX_JOINTS, TelemetryError
from telemetry.takes import SITES, Take, read_take

RESULT_SUFFIX = ".parquet"


def plot(
    files: Recordings,
    out: Annotated[Path, typer.Option("--out", help="PNG file to write.")] = Path("recording.png"),
    start: Annotated[
        float, typer.Option("--from", help="First session time [s].", show_default=False)
    ] = -math.inf,
    end: Annotated[
        float, typer.Option("--to", help="Last session time [s].", show_default=False)
    ] = math.inf,
    panel: Annotated[
        list[str] | None,
        typer.Option("--panel", help=f"Draw this one: {', '.join(PANELS)}; repeatable."),
    ] = None,
    take: TakeNumber = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite what is there.")] = False,
) -> None:
    """Draw recordings of one or both sites, or a result file, as one PNG."""
    with user_errors():
        for name in panel or ():
            if name not in PANELS:
                raise TelemetryError(f"--panel {name}: there are {', '.join(PANELS)}")
        if out.exists() and not force:
            raise TelemetryError(f"{out} exists: name another, or use --force")
        title, traces = _read(files, take)
        traces = [trace.within(start, end) for trace in traces]
        traces = [trace for trace in traces if len(trace.time_s)]
        if not traces:
            raise TelemetryError(f"nothing was recorded from {start:g} to {end:g} s")
        recording_figure(out, title, traces, {s.value: s.name for s in State}, panel or ())
        OUT.print(f"{out}", soft_wrap=True, markup=False)


def _read(files: list[Path], number: int | None) -> tuple[str, list[SiteTrace]]:
    results = [file for file in files if file.suffix == RESULT_SUFFIX]
    if not results:
        take = read_take(files, number)
        return _title(take), _of_take(take)
    if len(files) > 1:
        raise TelemetryError("a result file is drawn alone: it holds both sites")
    result = read_result(results[0])
    return results[0].stem, [_of_result(result, site) for site in SITES]


def _title(take: Take) -> str:
    start_ns, end_ns = take.span_ns
    start = datetime.fromtimestamp((start_ns + take.zero_wall_ns) // 10**9, UTC)
    gaps = sum(len(run.gaps) for run in take.runs)
    return (
        f"{take.metadata['session']} · {start:%Y-%m-%d %H:%M:%S} UTC · "
        f"{(end_ns - start_ns) * 1e-9:.1f} s" + (f" · {gaps} gaps, hatched" if gaps else "")
    )


def _of_take(take: Take) -> list[SiteTrace]:
    traces = []
    for site in SITES:
        if runs := take.of(site):
            rows = np.concatenate([run.rows for run in runs])
            time_s = np.concatenate([take.times_ns(run) for run in runs]) * 1e-9
            fields = {name: rows[name] for name in COLUMNS}
            traces.append(SiteTrace(site, time_s, fields))
    return traces


def _of_result(result: Result, site: str) -> SiteTrace:
    fields = {}
    for field, column in COLUMNS.items():
        names = [f"{site}_{name}" for name in column_names(field, MAX_JOINTS)]
        values = [result.columns[name] for name in names if name in result.columns]
        if values:
            fields[field] = values[0] if column.axis == "scalar" else np.column_stack(values)
    return SiteTrace(site, result.time_s, fields)
