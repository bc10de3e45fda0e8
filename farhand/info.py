"""`farhand info`: what a recording holds, at a glance."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer
from rich.table import Table
from rich.text import Text

from farhand.console import OUT, user_errors
from site_runtime.guard import Cut, cut_names
from telemetry.recorded_runs import recorded_runs, recording_files
from telemetry.recording import Recording
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]

SHOWN = 10


def info(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="Recordings (.mcap), or folders of them."),
    ],
) -> None:
    """Tell what recordings hold: duration, states, gaps, events, loop age, lateness, packets."""
    with user_errors():
        for run in recorded_runs(recording_files(paths)):
            OUT.print(_table(run))


def _table(run: Recording) -> Table:
    rows, metadata = run.rows, run.metadata
    stamps_ns = rows["stamp_ns"].astype(np.int64)
    duration_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    start = datetime.fromtimestamp(int(run.wall_times_ns[0]) * 1e-9, UTC)
    table = Table(
        title=f"{metadata['site']} site of {metadata['session']}, run {metadata['epoch']}",
        show_header=False,
        title_justify="left",
    )
    table.add_column(style="bold")
    table.add_column()
    rate_hz = (len(rows) - 1) / duration_s if duration_s > 0.0 else 0.0
    table.add_row("recorded", f"{start:%Y-%m-%d %H:%M:%S} UTC, {duration_s:.3f} s")
    table.add_row("rows", f"{len(rows)}, {rate_hz:.1f} a second; {_gaps(run)}")
    table.add_row("states", _states(rows, json.loads(metadata["states"])))
    loop_ms = 1e3 * rows["loop_bound_s"]
    certified_ms = 1e3 * float(rows["certified_round_trip_s"][-1])
    table.add_row(
        "loop age", f"{_percentiles(loop_ms)} ms, certified {certified_ms:.0f} ms; {_shares(rows)}"
    )
    table.add_row("round trip", f"{_percentiles(1e3 * rows['round_trip_s'])} ms")
    table.add_row("lateness", f"{_percentiles(1e-3 * rows['lateness_ns'])} µs")
    table.add_row("tick", f"{_percentiles(1e-3 * rows['duration_ns'])} µs of computing")
    counted = {name: int(rows[name][-1].sum()) for name in ("missed", "lost", "late", "rejected")}
    table.add_row("ticks", f"{counted['missed']} missed")
    table.add_row(
        "packets", ", ".join(f"{counted[name]} {name}" for name in ("lost", "late", "rejected"))
    )
    table.add_row("guard", _cuts(rows))
    table.add_row("events", _events(run, int(stamps_ns[0])))
    table.add_row("programs", f"farhand {metadata['farhand']}, Python {metadata['python']}")
    return table


def _gaps(run: Recording) -> str:
    closed = "" if run.complete else "; the file was cut off"
    if not run.gaps:
        return "no gap" + closed
    places = ", ".join(f"{gap.rows} from row {gap.first} on" for gap in run.gaps[:SHOWN])
    return f"{len(run.gaps)} gaps: {places}" + (", …" if len(run.gaps) > SHOWN else "") + closed


def _states(rows: RowArray, names: Mapping[str, str]) -> str:
    values, counts = np.unique(rows["state"], return_counts=True)
    changes = int(np.count_nonzero(np.diff(rows["state"])))
    shares = ", ".join(
        f"{names.get(str(value), value)} {count / len(rows):.1%}"
        for value, count in sorted(zip(values, counts, strict=True), key=lambda pair: -pair[1])
    )
    return f"{shares}; {changes} changes"


def _percentiles(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "none"
    p50, p99, p999, worst = np.percentile(known, (50, 99, 99.9, 100))
    return f"p50 {p50:.0f} · p99 {p99:.0f} · p99.9 {p999:.0f} · worst {worst:.0f}"


def _shares(rows: RowArray) -> str:
    beyond = np.count_nonzero(rows["loop_bound_s"] > rows["certified_round_trip_s"])
    return f"beyond it in {beyond / len(rows):.1%} of the ticks"


def _cuts(rows: RowArray) -> str:
    told = [
        f"{cut_names(cut)} in {count} ticks"
        for cut in Cut
        if cut and (count := np.count_nonzero(rows["cut"] & cut.value))
    ]
    return ", ".join(told) or "nothing cut"


def _events(run: Recording, start_ns: int) -> Text:
    lines = [f"{(e.stamp_ns - start_ns) * 1e-9:9.3f} s  {e.text}" for e in run.events]
    if len(lines) > 2 * SHOWN:
        left_out = len(lines) - 2 * SHOWN
        lines = [*lines[:SHOWN], f"… {left_out} more …", *lines[-SHOWN:]]
    return Text("\n".join(lines) or "none")
