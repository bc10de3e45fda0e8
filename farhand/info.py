"""`farhand info`: what a recording holds, at a glance."""

import json
from collections.abc import Iterator, Mapping, Sequence
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
from telemetry.latency import STAGES, sample_latencies, stage_percentiles_us
from telemetry.recorded_runs import recorded_runs, recording_files
from telemetry.recording import Recording
from telemetry.rows import REJECT_REASONS, RowArray

FloatArray = npt.NDArray[np.float64]

SHOWN = 10
PERCENTS = (50, 99, 99.9)


def info(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="Recordings (.mcap), or folders of them."),
    ],
) -> None:
    """Tell what recordings hold: duration, states, gaps, events, loop age, lateness, packets.

    Of recordings of both sites, also where the time goes from one device to the other.
    """
    with user_errors():
        runs = recorded_runs(recording_files(paths))
        for run in runs:
            OUT.print(_table(run))
        for local, remote in _pairs(runs):
            OUT.print(_latency_table(local, remote))


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
    packets = ", ".join(f"{counted[name]} {name}" for name in ("lost", "late", "rejected"))
    table.add_row("packets", packets + _reasons(rows))
    table.add_row("guard", _cuts(rows))
    table.add_row("events", _events(run, int(stamps_ns[0])))
    table.add_row("programs", f"farhand {metadata['farhand']}, Python {metadata['python']}")
    return table


def _pairs(runs: Sequence[Recording]) -> Iterator[tuple[Recording, Recording]]:
    """Pair local and remote runs of one session that overlap in time."""
    for local in runs:
        for remote in runs:
            sites = (local.metadata["site"], remote.metadata["site"])
            alike = local.metadata["digest"] == remote.metadata["digest"]
            if sites != ("local", "remote") or not alike:
                continue
            start_ns = max(run.wall_times_ns[0] for run in (local, remote))
            end_ns = min(run.wall_times_ns[-1] for run in (local, remote))
            if start_ns < end_ns:
                yield local, remote


def _latency_table(local: Recording, remote: Recording) -> Table:
    """Where the time goes, stage by stage, both ways."""
    ways = {
        "local → remote": sample_latencies(local.rows, remote.rows),
        "remote → local": sample_latencies(remote.rows, local.rows),
    }
    table = Table(title="from one device to the other [µs]", title_justify="left")
    table.add_column("stage")
    for way in ways:
        table.add_column(f"{way}  p50", justify="right")
        for percent in PERCENTS[1:]:
            table.add_column(f"p{percent:g}", justify="right")
    columns = [stage_percentiles_us(found, PERCENTS) for found in ways.values()]
    for stage in (*STAGES, "total"):
        cells = [f"{value:.0f}" for column in columns for value in column[stage]]
        table.add_row(stage, *cells, style="bold" if stage == "total" else None)
    table.caption = "; ".join(
        f"{way}: {len(found)} samples, network ± {np.median(found['uncertainty']) * 1e-3:.0f} µs"
        for way, found in ways.items()
        if len(found)
    )
    return table


def _reasons(rows: RowArray) -> str:
    counts = np.atleast_1d(rows["rejected"][-1])
    if len(counts) != len(REJECT_REASONS) or not counts.any():
        return ""
    told = [f"{n} {reason}" for reason, n in zip(REJECT_REASONS, counts, strict=True) if n]
    return f" ({', '.join(told)})"


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
