"""Result files: the rows of both sites of one run as a Parquet table that any tool can read.

The columns are described in docs/result_file.md.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from types import MappingProxyType
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from telemetry.rows import (
    COLUMNS,
    DERIVED,
    LAYOUT_VERSION,
    REJECT_REASONS,
    Column,
    Derive,
    DerivedColumns,
    RowArray,
    TelemetryError,
)

FloatArray = npt.NDArray[np.float64]

SITE_NAMES: Final = ("local", "remote")
TIME_COLUMN: Final = "time_s"

_UNIT_SUFFIX: Final = {"m": "_m", "m/s": "_m_s", "N": "_n", "N·m": "_nm"}
_LAYOUT_KEY: Final = "layout_version"
_DESCRIBED: Final = {**COLUMNS, **DERIVED}


@dataclass(frozen=True, slots=True)
class Result:
    """One run, read back: time [s] of every tick, columns by name, and what was said about it."""

    time_s: FloatArray
    columns: Mapping[str, npt.NDArray[Any]]
    metadata: Mapping[str, str]


def column_names(field: str, length: int) -> tuple[str, ...]:
    """Names of the columns that hold one field, without the site: `q_1`, `position_x`, `state`.

    Numbered by joint, lettered by axis, there the unit is left to the metadata of the column; named
    by reason.
    """
    column = _DESCRIBED[field]
    if column.axis == "scalar":
        return (field,)
    stem = field.removesuffix(_UNIT_SUFFIX.get(column.unit, ""))
    suffixes: Mapping[str, Sequence[str | int]] = {
        "task": "xyz",
        "joint": range(1, length + 1),
        "reason": [reason.replace(" ", "_").replace("-", "_") for reason in REJECT_REASONS],
    }
    return tuple(f"{stem}_{suffix}" for suffix in suffixes[column.axis][:length])


def table_columns(
    rows: RowArray, derived: DerivedColumns
) -> Iterator[tuple[str, npt.NDArray[Any], Column]]:
    """Yield what rows (r,) are as columns of a table: name, values (r,), description."""
    fields = {name: rows[name] for name in COLUMNS}
    for name, values in (fields | dict(derived)).items():
        columns = values if values.ndim == 2 else values[:, np.newaxis]
        for i, label in enumerate(column_names(name, columns.shape[1])):
            yield label, np.ascontiguousarray(columns[:, i]), _DESCRIBED[name]


def write_result(
    path: str | PathLike[str] | BinaryIO,
    local_rows: RowArray,
    remote_rows: RowArray,
    metadata: Mapping[str, str],
    derive: Derive,
) -> None:
    """Write the rows of both sites, which share their ticks, as one Parquet table.

    Equal rows and metadata give the same bytes. `metadata` is free text (the session file, versions
    of the programs); `derive` works out what rows do not hold. TelemetryError if the two sites'
    `time_ns` differ, or if it cannot be written.
    """
    if not np.array_equal(local_rows["time_ns"], remote_rows["time_ns"]):
        raise TelemetryError(
            f"the sites do not share their ticks ({len(local_rows)} local and {len(remote_rows)} "
            "remote rows): a result has one row a tick with both sites in it"
        )
    if _LAYOUT_KEY in metadata:
        raise TelemetryError(f"metadata key {_LAYOUT_KEY!r} is the file's own: use another name")
    fields = [_field(TIME_COLUMN, pa.float64(), "s", COLUMNS["time_ns"].meaning)]
    arrays = [pa.array(local_rows["time_ns"] * 1e-9)]
    for site, rows in zip(SITE_NAMES, (local_rows, remote_rows), strict=True):
        for name, values, column in table_columns(rows, derive(site, rows["q"])):
            if name == "time_ns":
                continue
            array = pa.array(values)
            arrays.append(array)
            fields.append(_field(f"{site}_{name}", array.type, column.unit, column.meaning))
    text = {_LAYOUT_KEY: str(LAYOUT_VERSION)} | {key: metadata[key] for key in sorted(metadata)}
    table = pa.table(arrays, schema=pa.schema(fields, metadata=text))
    try:
        pq.write_table(table, path, compression="zstd", compression_level=3)
    except OSError as error:
        raise TelemetryError(f"cannot write the result {path}: {error}") from error


def read_result(path: str | PathLike[str] | BinaryIO) -> Result:
    """Read what `write_result` wrote; TelemetryError if it is not that."""
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise TelemetryError(f"cannot read the result {path}: {error}") from error
    text = {
        key.decode(): value.decode()
        for key, value in (table.schema.metadata or {}).items()
        if not key.startswith(b"ARROW:")
    }
    version = text.pop(_LAYOUT_KEY, None)
    if version != str(LAYOUT_VERSION):
        raise TelemetryError(
            f"{path} has layout version {version}, this program reads {LAYOUT_VERSION}: "
            "read it with the version of farhand that wrote it"
        )
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    time_s = columns.pop(TIME_COLUMN)
    return Result(time_s, MappingProxyType(columns), MappingProxyType(text))


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, nullable=False, metadata={"unit": unit, "meaning": meaning})
