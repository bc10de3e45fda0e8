"""Takes as tables that any tool can read: Parquet or CSV, a table a run, and one of the events.

The columns are those of result files, without the site's name before them; see docs/tools.md.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

from telemetry.recording import SESSION_FILE, Recording
from telemetry.result_file import TIME_COLUMN, table_columns, write_result
from telemetry.rows import Derive
from telemetry.takes import SITES, Take, joined_rows

WALL_COLUMN: Final = "wall_time_ns"
EVENTS: Final = "events"

_SESSION_TIME: Final = "Start of the tick in session time, on one timeline for both sites"
_WALL_TIME: Final = "The same since 1970, by the wall clock of the site that gives the time"


def write_parquet(folder: Path, take: Take, derive: Derive) -> list[Path]:
    """Write the tables of a take into a folder; units and meanings are the columns' metadata."""
    return _write(
        folder,
        take,
        derive,
        ".parquet",
        lambda table, path: pq.write_table(table, path, compression="zstd", compression_level=3),
    )


def write_csv(folder: Path, take: Take, derive: Derive) -> list[Path]:
    """Write the tables of a take into a folder; units are in the columns' names: `q_1 [rad]`."""
    return _write(
        folder, take, derive, ".csv", lambda table, path: pc.write_csv(_named(table), path)
    )


def write_joined(path: Path, take: Take, derive: Derive) -> None:
    """Write a take as a result file: a row a local tick, with the newest remote row of then."""
    local, remote = joined_rows(take)
    remote = remote.copy()
    remote["time_ns"] = local["time_ns"]
    told = {
        f"{run.metadata['site']}_run": json.dumps(run_metadata(run) | {"session_text": ""})
        for run in take.runs
    }
    digest = {"session_digest": take.metadata["digest"]}
    write_result(path, local, remote, {"session": take.session_text, **digest, **told}, derive)


def run_table(take: Take, run: Recording, derive: Derive) -> pa.Table:
    """Return the rows of one run, all of them, bit by bit, and what is derived from them."""
    times_ns = take.times_ns(run)
    columns = [
        _column(TIME_COLUMN, times_ns * 1e-9, "s", _SESSION_TIME),
        _column(WALL_COLUMN, times_ns + take.zero_wall_ns, "ns", _WALL_TIME),
    ]
    derived = derive(run.metadata["site"], run.rows["q"])
    for name, values, column in table_columns(run.rows, derived):
        columns.append(_column(name, values, column.unit, column.meaning))
    return _table(columns, run_metadata(run))


def event_table(take: Take) -> pa.Table:
    """Return what the sites, and their recorders, said, in the order of time."""
    told = sorted(
        (event.stamp_ns + take.offset_ns(run), run.metadata["site"], event.text)
        for run in take.runs
        for event in run.events
    )
    times_ns = np.array([time_ns for time_ns, _, _ in told], np.int64)
    columns = [_column(TIME_COLUMN, times_ns * 1e-9, "s", _SESSION_TIME)]
    for name, values, meaning in (
        ("site", [site for _, site, _ in told], "Who said it"),
        ("text", [text for _, _, text in told], "What was said"),
    ):
        field = pa.field(name, pa.string(), False, {"unit": "1", "meaning": meaning})
        columns.append((field, pa.array(values, pa.string())))
    return _table(columns, {})


def run_metadata(run: Recording) -> dict[str, str]:
    """Return what was said about a run, its session file, and its gaps as (first row, rows)."""
    gaps = json.dumps([[gap.first, gap.rows] for gap in run.gaps])
    return {**run.metadata, "session_text": run.session_text, "gaps": gaps}


def _write(
    folder: Path,
    take: Take,
    derive: Derive,
    suffix: str,
    write: Callable[[pa.Table, Path], None],
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for site in SITES:
        runs = take.of(site)
        for number, run in enumerate(runs, 1):
            name = site if len(runs) == 1 else f"{site}-{number}"
            written.append(folder / f"{name}{suffix}")
            write(run_table(take, run, derive), written[-1])
    written.append(folder / f"{EVENTS}{suffix}")
    write(event_table(take), written[-1])
    written.append(folder / SESSION_FILE)
    written[-1].write_text(take.session_text, encoding="utf-8")
    return written


def _column(
    name: str, values: npt.NDArray[Any], unit: str, meaning: str
) -> tuple[pa.Field, pa.Array]:
    array = pa.array(values)
    return pa.field(name, array.type, False, {"unit": unit, "meaning": meaning}), array


def _table(columns: Sequence[tuple[pa.Field, pa.Array]], metadata: dict[str, str]) -> pa.Table:
    schema = pa.schema([field for field, _ in columns], metadata=metadata)
    return pa.table([array for _, array in columns], schema=schema)


def _named(table: pa.Table) -> pa.Table:
    """Return a table whose columns name their units: `q_1 [rad]`, `round_trip_s`."""
    names = []
    for field in table.schema:
        unit = field.metadata[b"unit"].decode()
        told = unit == "1" or field.name.endswith("_" + unit.replace("/", "_"))
        names.append(field.name if told else f"{field.name} [{unit}]")
    return table.rename_columns(names)
