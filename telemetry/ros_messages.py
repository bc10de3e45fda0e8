"""Rows and events as ROS 2 messages: the schema's text, and CDR bytes of many rows at once.

CDR (OMG DDS-XTypes 7.4, plain, little-endian): four bytes of encapsulation header, then the fields,
each aligned to its own size counted from the end of that header; fixed arrays have no length.
"""

import re
import struct
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from telemetry.row_ring import ARRIVAL, ARRIVAL_BYTES, SiteEvent
from telemetry.rows import COLUMNS, RowArray, TelemetryError, row_dtype

SCHEMA_ENCODING: Final = "ros2msg"
MESSAGE_ENCODING: Final = "cdr"

EVENT_SCHEMA: Final = """\
# Something a site, or its recorder, said of itself.
int64 stamp_ns  # [ns] On the site's own clock
string text
"""

ARRIVALS_SCHEMA: Final = f"""\
# Datagrams that the link brought, as they came; their format is that of docs/packet.md.
Arrival[] arrivals
================================================================================
MSG: farhand/Arrival
uint64 number  # [1] Arrivals before this one
uint64 row  # [1] Sequence of the row of the tick that took it
uint32 length  # [1] Bytes that it had; of a longer one than there is room for, the first are kept
uint8[{ARRIVAL_BYTES}] data
"""

_CDR_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"
_ENCAPSULATION: Final = "encapsulation"
_EVENT: Final = struct.Struct("<qI")
_COUNT: Final = struct.Struct("<I4x")  # what follows is aligned to its largest number
_FIELD: Final = re.compile(r"(?P<type>\w+?)(\[(?P<length>\d+)\])? (?P<name>\w+)")
_ROS_TYPES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "|u1": "uint8",
        "|i1": "int8",
        "|b1": "bool",
        "<u2": "uint16",
        "<i2": "int16",
        "<u4": "uint32",
        "<i4": "int32",
        "<u8": "uint64",
        "<i8": "int64",
        "<f4": "float32",
        "<f8": "float64",
    }
)
_FORMATS: Final = MappingProxyType({name: code for code, name in _ROS_TYPES.items()})


def row_schema(joints: int, dimension: int) -> str:
    """Return the text of a row's message definition, units and meanings as comments."""
    dtype = row_dtype(joints, dimension)
    lines = ["# One tick of a site."]
    for name, column in COLUMNS.items():
        field = dtype[name]
        length = f"[{field.shape[0]}]" if field.shape else ""
        ros_type = _ROS_TYPES[field.base.str]
        lines.append(f"{ros_type}{length} {name}  # [{column.unit}] {column.meaning}")
    return "\n".join(lines) + "\n"


def dtype_of(schema: str) -> np.dtype[np.void]:
    """Return the packed dtype of the rows that a message definition describes.

    So a recording is read by its own schema, whatever columns it has. TelemetryError for
    definitions other than of numbers and fixed arrays of numbers.
    """
    fields: list[Any] = []
    for line in schema.splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        field = _FIELD.fullmatch(" ".join(words))
        if field is None or field["type"] not in _FORMATS:
            raise TelemetryError(f"{line!r} defines no number and no fixed array of numbers")
        shape = () if field["length"] is None else (int(field["length"]),)
        fields.append((field["name"], _FORMATS[field["type"]], shape))
    return np.dtype(fields)


def message_dtype(rows: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the dtype of the whole message of one row: its header, then its fields aligned."""
    aligned = np.dtype([(name, rows[name]) for name in rows.names or ()], align=True)
    places: list[Any] = list((aligned.fields or {}).values())
    offsets = [len(_CDR_LITTLE_ENDIAN) + place[1] for place in places]
    return np.dtype(
        {
            "names": [_ENCAPSULATION, *(aligned.names or ())],
            "formats": [f"V{len(_CDR_LITTLE_ENDIAN)}", *(place[0] for place in places)],
            "offsets": [0, *offsets],
            # no padding after the last field: there is none in CDR
            "itemsize": offsets[-1] + places[-1][0].itemsize,
        }
    )


def encode_rows(rows: RowArray) -> list[bytes]:
    """Return one message a row."""
    dtype = message_dtype(rows.dtype)
    messages = np.zeros(len(rows), dtype)
    messages[_ENCAPSULATION] = np.void(_CDR_LITTLE_ENDIAN)
    for name in rows.dtype.names or ():
        messages[name] = rows[name]
    data, size = messages.tobytes(), dtype.itemsize
    return [data[start : start + size] for start in range(0, len(data), size)]


def decode_rows(messages: list[bytes], dtype: np.dtype[np.void]) -> RowArray:
    """Return the rows, of this packed dtype, that `encode_rows` made messages of."""
    whole = np.frombuffer(b"".join(messages), message_dtype(dtype))
    rows = np.zeros(len(whole), dtype)
    for name in dtype.names or ():
        rows[name] = whole[name]
    return rows


def encode_arrivals(arrivals: RowArray) -> bytes:
    """Return one message of all these, dtype `ARRIVAL`."""
    return _CDR_LITTLE_ENDIAN + _COUNT.pack(len(arrivals)) + arrivals.tobytes()


def decode_arrivals(message: bytes) -> RowArray:
    """Return the arrivals that `encode_arrivals` made a message of."""
    start = len(_CDR_LITTLE_ENDIAN)
    (count,) = _COUNT.unpack_from(message, start)
    return np.frombuffer(message, ARRIVAL, count, start + _COUNT.size)


def encode_event(event: SiteEvent) -> bytes:
    """Return the message of one event."""
    text = event.text.encode(errors="replace") + b"\0"
    return _CDR_LITTLE_ENDIAN + _EVENT.pack(event.stamp_ns, len(text)) + text


def decode_event(message: bytes) -> SiteEvent:
    """Return the event that `encode_event` made a message of."""
    start = len(_CDR_LITTLE_ENDIAN)
    stamp_ns, length = _EVENT.unpack_from(message, start)
    start += _EVENT.size
    return SiteEvent(stamp_ns, message[start : start + length - 1].decode(errors="replace"))
