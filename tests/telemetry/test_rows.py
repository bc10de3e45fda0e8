import numpy as np
import pytest

from telemetry.rows import COLUMNS, TelemetryError, row_dtype, row_struct


@pytest.mark.parametrize(("joints", "dimension"), [(2, 2), (3, 2), (7, 3)])
def test_every_field_is_documented_and_has_its_length(joints: int, dimension: int) -> None:
    dtype = row_dtype(joints, dimension)
    assert dtype.names == tuple(COLUMNS)
    lengths = {"scalar": (), "joint": (joints,), "task": (dimension,), "reason": (12,)}
    for name, column in COLUMNS.items():
        assert column.unit
        assert (
            column.meaning[0].isupper() or not column.meaning[0].isalpha() or "(" in column.meaning
        )
        assert dtype[name].shape == lengths[column.axis]


@pytest.mark.parametrize(("joints", "dimension"), [(1, 2), (3, 2), (16, 3)])
def test_numbers_packed_in_order_are_the_row(joints: int, dimension: int) -> None:
    dtype = row_dtype(joints, dimension)
    packer = row_struct(dtype)
    assert packer.size == dtype.itemsize
    row = np.zeros(1, dtype)
    numbers: list[float] = []
    for name in dtype.names:
        count = dtype[name].shape[0] if dtype[name].shape else 1
        values = list(range(len(numbers), len(numbers) + count))
        row[name] = values if dtype[name].shape else values[0]
        numbers += values
    assert packer.pack(*numbers) == row.tobytes()


def test_rows_are_packed_and_little_endian() -> None:
    dtype = row_dtype(3, 2)
    assert dtype.itemsize == sum(dtype[name].itemsize for name in dtype.names)
    assert all(dtype[name].base.str[0] in "<|" for name in dtype.names)
    assert dtype["state"] == dtype["peer_state"] == np.uint8
    assert dtype["cut"] == np.uint16


@pytest.mark.parametrize(("joints", "dimension"), [(0, 2), (17, 2), (3, 1), (3, 4)])
def test_shapes_no_arm_has_are_refused(joints: int, dimension: int) -> None:
    with pytest.raises(TelemetryError, match="rows hold"):
        row_dtype(joints, dimension)
