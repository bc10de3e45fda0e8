"""Where a packet's fields are and what they hold, found by asking `encode`: no number twice."""

import inspect
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from channel.packet import MAGIC, Packet, encode

_NAMES = [name for name in inspect.signature(encode).parameters if name != "vectors"]
_FORMATS = "qQiIhHbB"  # widest first: the first that takes both its extremes is the field's
CHECKSUM = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class Field:
    """One integer of the header: its name in `encode`, its place, and its least and most value."""

    name: str
    offset: int
    format: str
    least: int
    most: int

    def read(self, data: bytes) -> int:
        """Return the field of a packet."""
        return int(struct.unpack_from(self.format, data, self.offset)[0])

    def written(self, data: bytes, value: int) -> bytes:
        """Return the packet with another value there, its checksum as it was."""
        return overwritten(data, self.offset, struct.pack(self.format, value))


def example(dimension: int = 2, **changes: Any) -> bytes:
    """Return a packet of zeros but for the changes."""
    values = dict.fromkeys(_NAMES, 0) | {"vectors": np.zeros((3, dimension))}
    return encode(**(values | changes))


def reencoded(packet: Packet) -> bytes:
    """Return the bytes of a decoded packet."""
    vectors = np.stack([packet.position_m, packet.velocity_m_s, packet.force_n])
    return encode(**{name: getattr(packet, name) for name in _NAMES}, vectors=vectors)


def resealed(data: bytes) -> bytes:
    """Return the bytes with the checksum that belongs to them."""
    body = data[: -CHECKSUM.size]
    return body + CHECKSUM.pack(zlib.crc32(body))


def overwritten(data: bytes, offset: int, part: bytes) -> bytes:
    """Return the bytes with `part` at `offset`."""
    return data[:offset] + part + data[offset + len(part) :]


def _first_difference(a: bytes, b: bytes) -> int:
    return next(place for place, (x, y) in enumerate(zip(a, b, strict=False)) if x != y)


def _field(name: str) -> Field:
    offset = _first_difference(example(), example(**{name: 1}))
    for number in _FORMATS:
        bits = 8 * struct.calcsize(number)
        signed = number.islower()
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        try:
            example(**{name: low})
            example(**{name: high})
        except struct.error:
            continue
        return Field(name, offset, f"<{number}", low, high)
    raise TypeError(f"{name} is no integer that these tests know")


FIELDS = tuple(_field(name) for name in _NAMES)
BY_NAME = {field.name: field for field in FIELDS}
VERSION_OFFSET = len(MAGIC)
DIMENSION_OFFSET = _first_difference(example(2), example(3))
VECTORS_OFFSET = _first_difference(example(), example(vectors=np.full((3, 2), -1.1)))
SIZES = {dimension: len(example(dimension)) for dimension in (2, 3)}
