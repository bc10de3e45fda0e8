import numpy as np
import pytest

from telemetry.rows import COLUMNS, TelemetryError, row_dtype


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
