"""The packet between the sites: one fixed little-endian layout, documented in docs/packet.md."""

import struct
import zlib
from enum import Enum
from math import isfinite
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

MAGIC = b"FARH"
VERSION = 2
NO_STAMP = -1
"""In `used_stamp_ns`: the sender was using no sample of its peer's."""
NO_AGE = -(2**63)
"""In `greatest_age_ns`: the same, within the time that it looks back on."""
NO_EPOCH = 0
"""In `echo_epoch`: the sender has heard no peer; the other echo fields then mean nothing."""

_DIMENSIONS = (2, 3)
_DOUBLE = np.dtype("<f8")
_HEADER = struct.Struct("<4sBBBBQQQqQqqqq")
_CHECKSUM = struct.Struct("<I")
_SIZES = {z: _HEADER.size + 3 * 8 * z + _CHECKSUM.size for z in _DIMENSIONS}


class Reject(Enum):
    """Why a packet was ignored: the first six by its bytes, the others by what was heard before."""

    LENGTH = "length"
    MAGIC = "magic"
    VERSION = "version"
    DIMENSION = "dimension"
    CHECKSUM = "checksum"
    NON_FINITE = "non-finite"
    SITE = "site"
    SESSION = "session"
    EPOCH = "epoch"
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out of order"
    STAMP = "stamp"


class PacketError(Exception):
    """Bytes that are no packet of this version; `reason` is one of Reject's byte-level values."""

    def __init__(self, reason: Reject, detail: str) -> None:
        super().__init__(f"{reason.value}: {detail}")
        self.reason = reason


class Packet(NamedTuple):
    """One packet; vectors (z,) in base axes, z = 2 or 3, read-only.

    Stamps are nanoseconds: `stamp_ns` and `echo_arrival_ns` on the sender's monotonic clock,
    `echo_stamp_ns` and `used_stamp_ns` on its peer's. `greatest_age_ns` is a difference of the two
    clocks, the sender's minus its peer's.
    """

    site: int
    state: int
    session: int
    epoch: int
    sequence: int
    stamp_ns: int
    echo_epoch: int
    echo_stamp_ns: int
    echo_arrival_ns: int
    used_stamp_ns: int
    greatest_age_ns: int
    position_m: FloatArray
    velocity_m_s: FloatArray
    force_n: FloatArray


def encode(
    *,
    site: int,
    state: int,
    session: int,
    epoch: int,
    sequence: int,
    stamp_ns: int,
    echo_epoch: int,
    echo_stamp_ns: int,
    echo_arrival_ns: int,
    used_stamp_ns: int,
    greatest_age_ns: int,
    vectors: FloatArray,
) -> bytes:
    """Return the bytes of a packet.

    `vectors` is (3, z), C-contiguous: position [m], velocity [m/s], force [N].
    """
    body = (
        _HEADER.pack(
            MAGIC,
            VERSION,
            site,
            state,
            vectors.shape[1],
            session,
            epoch,
            sequence,
            stamp_ns,
            echo_epoch,
            echo_stamp_ns,
            echo_arrival_ns,
            used_stamp_ns,
            greatest_age_ns,
        )
        + vectors.astype("<f8", copy=False).tobytes()
    )
    return body + _CHECKSUM.pack(zlib.crc32(body))


def decode(data: bytes) -> Packet:
    """Return the packet in `data`; raise PacketError, and nothing else, if it is not one."""
    size = len(data)
    if size < _HEADER.size:
        raise PacketError(Reject.LENGTH, f"{size} bytes, the header alone has {_HEADER.size}")
    (
        magic,
        version,
        site,
        state,
        dimension,
        session,
        epoch,
        sequence,
        stamp_ns,
        echo_epoch,
        echo_stamp_ns,
        echo_arrival_ns,
        used_stamp_ns,
        greatest_age_ns,
    ) = _HEADER.unpack_from(data)
    # these two stay the same in every version, nothing behind them has to
    if magic != MAGIC:
        raise PacketError(Reject.MAGIC, f"starts with {magic!r}, not with {MAGIC!r}")
    if version != VERSION:
        raise PacketError(
            Reject.VERSION, f"layout {version}, this program speaks {VERSION}: update the older"
        )
    expected = _SIZES.get(dimension)
    if expected is None:
        raise PacketError(Reject.DIMENSION, f"task dimension {dimension}, must be 2 or 3")
    if size != expected:
        raise PacketError(
            Reject.LENGTH, f"{size} bytes, task dimension {dimension} takes {expected}"
        )
    body_size = size - _CHECKSUM.size
    (checksum,) = _CHECKSUM.unpack_from(data, body_size)
    if zlib.crc32(memoryview(data)[:body_size]) != checksum:
        raise PacketError(Reject.CHECKSUM, f"CRC-32 is not the {checksum:#010x} it carries")
    vectors = np.frombuffer(data, _DOUBLE, 3 * dimension, _HEADER.size)
    # a sum may overflow for great numbers too: then look closely
    if not isfinite(sum(vectors.tolist())) and not np.isfinite(vectors).all():
        raise PacketError(Reject.NON_FINITE, f"position, velocity, force = {vectors.tolist()}")
    return Packet(
        site,
        state,
        session,
        epoch,
        sequence,
        stamp_ns,
        echo_epoch,
        echo_stamp_ns,
        echo_arrival_ns,
        used_stamp_ns,
        greatest_age_ns,
        vectors[:dimension],
        vectors[dimension : 2 * dimension],
        vectors[2 * dimension :],
    )
