import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import pytest

from telemetry.result_file import SITE_NAMES, column_names, read_result, write_result
from telemetry.rows import COLUMNS, DERIVED, RowArray, TelemetryError, nothing_derived, row_dtype

PAGE = Path(__file__).parents[2] / "docs" / "result_file.md"
FloatArray = npt.NDArray[np.float64]
Sites = tuple[RowArray, RowArray]

METADATA = {"session": "[local]\nrobot = '2R'\n", "farhand": "0.1.0", "Ω": "200 N/m"}


def rows_of(joints: int, dimension: int, count: int = 200, seed: int = 1) -> RowArray:
    random = np.random.default_rng(seed)
    rows = np.zeros(count, row_dtype(joints, dimension))
    for name in rows.dtype.names:
        shape = rows[name].shape
        if COLUMNS[name].format == "<f8":
            rows[name] = random.normal(size=shape)
        else:
            rows[name] = random.integers(0, 250, size=shape)
    rows["time_ns"] = np.arange(count) * 1_000_000
    rows["peer_position_m"][:50] = np.nan
    return rows


def derive(site: str, q: FloatArray) -> dict[str, FloatArray]:
    """Stand in for what robots and obstacles would tell: of angles, what is easily checked."""
    return {name: q[:, place % q.shape[1]] + len(site) for place, name in enumerate(DERIVED)}


@pytest.fixture
def sites() -> Sites:
    return rows_of(2, 2, seed=1), rows_of(3, 2, seed=2)


def test_what_is_written_reads_back_bit_for_bit(tmp_path: Path, sites: Sites) -> None:
    write_result(tmp_path / "run.parquet", *sites, METADATA, derive)
    result = read_result(tmp_path / "run.parquet")
    assert result.metadata == METADATA
    assert np.array_equal(result.time_s, np.arange(200) * 1_000_000 * 1e-9)
    expected = {}
    for site, rows in zip(SITE_NAMES, sites, strict=True):
        for field in rows.dtype.names:
            values = rows[field].reshape(len(rows), -1)
            for name, column in zip(column_names(field, values.shape[1]), values.T, strict=True):
                expected[f"{site}_{name}"] = column
        for name, values in derive(site, rows["q"]).items():
            expected[f"{site}_{name}"] = values
    del expected["local_time_ns"], expected["remote_time_ns"]
    assert list(result.columns) == list(expected)
    for name, column in expected.items():
        assert result.columns[name].dtype == column.dtype.newbyteorder("=")
        assert result.columns[name].tobytes() == column.tobytes(), name
    assert "remote_position_x" in expected
    assert "local_torque_2" in expected
    assert "remote_q_3" in expected


def test_equal_runs_give_equal_bytes(tmp_path: Path, sites: Sites) -> None:
    write_result(tmp_path / "a.parquet", *sites, METADATA, derive)
    reordered = dict(reversed(METADATA.items()))
    write_result(tmp_path / "b.parquet", *(rows.copy() for rows in sites), reordered, derive)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    sites[0]["q"][7, 1] += 1e-15
    write_result(tmp_path / "c.parquet", *sites, METADATA, derive)
    assert (tmp_path / "a.parquet").read_bytes() != (tmp_path / "c.parquet").read_bytes()


def test_a_run_without_rows_reads_back_without_rows(tmp_path: Path, sites: Sites) -> None:
    local, remote = (rows[:0] for rows in sites)
    write_result(tmp_path / "empty.parquet", local, remote, METADATA, derive)
    write_result(tmp_path / "run.parquet", *sites, METADATA, derive)
    empty, full = (read_result(tmp_path / f"{name}.parquet") for name in ("empty", "run"))
    assert empty.time_s.shape == (0,)
    assert empty.metadata == METADATA
    assert list(empty.columns) == list(full.columns)


def test_columns_say_their_unit_and_meaning(tmp_path: Path, sites: Sites) -> None:
    write_result(tmp_path / "run.parquet", *sites, METADATA, derive)
    schema = pq.read_schema(tmp_path / "run.parquet")
    assert schema.field("time_s").metadata[b"unit"] == b"s"
    for name in ("q_dot", "torque_nm", "position_m", "manipulability"):
        column = (COLUMNS | DERIVED)[name]
        for suffix in column_names(name, 2):
            metadata = schema.field(f"local_{suffix}").metadata
            assert metadata[b"unit"].decode() == column.unit
            assert metadata[b"meaning"].decode() == column.meaning


def test_what_cannot_be_derived_is_left_out(tmp_path: Path, sites: Sites) -> None:
    write_result(tmp_path / "run.parquet", *sites, METADATA, nothing_derived)
    write_result(tmp_path / "all.parquet", *sites, METADATA, derive)
    columns, whole = (read_result(tmp_path / f"{name}.parquet").columns for name in ("run", "all"))
    missing = {f"{site}_{name}" for site in SITE_NAMES for name in DERIVED}
    assert set(whole) - set(columns) == missing


def test_sites_that_do_not_share_their_ticks_are_refused(tmp_path: Path, sites: Sites) -> None:
    local, remote = sites
    with pytest.raises(TelemetryError, match="199 local and 200 remote"):
        write_result(tmp_path / "run.parquet", local[:-1], remote, {}, derive)
    remote["time_ns"][-1] += 1
    with pytest.raises(TelemetryError, match="share their ticks"):
        write_result(tmp_path / "run.parquet", local, remote, {}, derive)


def test_the_files_own_metadata_key_is_reserved(tmp_path: Path, sites: Sites) -> None:
    with pytest.raises(TelemetryError, match="layout_version"):
        write_result(tmp_path / "run.parquet", *sites, {"layout_version": "7"}, derive)


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, sites: Sites) -> None:
    with pytest.raises(TelemetryError, match="nowhere"):
        write_result(tmp_path / "nowhere" / "run.parquet", *sites, {}, derive)


def test_what_is_no_result_is_refused(tmp_path: Path, sites: Sites) -> None:
    with pytest.raises(TelemetryError, match="cannot read"):
        read_result(tmp_path / "absent.parquet")
    (tmp_path / "noise.parquet").write_bytes(b"PAR1 and then nothing of the kind")
    with pytest.raises(TelemetryError, match="cannot read"):
        read_result(tmp_path / "noise.parquet")
    write_result(tmp_path / "run.parquet", *sites, {}, derive)
    table = pq.read_table(tmp_path / "run.parquet").replace_schema_metadata({})
    pq.write_table(table, tmp_path / "foreign.parquet")
    with pytest.raises(TelemetryError, match="layout version None"):
        read_result(tmp_path / "foreign.parquet")


def test_the_page_documents_exactly_the_columns() -> None:
    documented = {}
    for line in PAGE.read_text().splitlines():
        if match := re.fullmatch(r"\| (`.*) \| (.*) \| (.*) \|", line):
            names, unit, meaning = match.groups()
            documented[tuple(re.findall(r"`(\w+)`", names))] = (unit, meaning)
    lengths = {"scalar": 1, "joint": 1, "task": 3, "reason": 12}
    assert documented == {
        column_names(name, lengths[column.axis]): (column.unit, column.meaning)
        for name, column in (COLUMNS | DERIVED).items()
        if name != "time_ns"
    }
