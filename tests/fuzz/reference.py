"""What docs/packet.md says a receiver does with any bytes; written from that page, not the code."""

import struct
import zlib
from dataclasses import dataclass
from math import isfinite

from channel.packet import MAGIC, VERSION, Reject
from tests.fuzz.layout import (
    BY_NAME,
    CHECKSUM,
    DIMENSION_OFFSET,
    SIZES,
    VECTORS_OFFSET,
    VERSION_OFFSET,
)


@dataclass(frozen=True, slots=True)
class Receiver:
    """A site in a running exchange: who it is, and the newest packet it has heard."""

    site: int
    session: int
    dimension: int
    newest: bytes


def reason_in_bytes(data: bytes) -> Reject | None:
    """Return why these bytes are no packet; None if they are one."""
    if len(data) < VECTORS_OFFSET:
        return Reject.LENGTH
    if data[: len(MAGIC)] != MAGIC:
        return Reject.MAGIC
    if data[VERSION_OFFSET] != VERSION:
        return Reject.VERSION
    dimension = data[DIMENSION_OFFSET]
    if dimension not in SIZES:
        return Reject.DIMENSION
    if len(data) != SIZES[dimension]:
        return Reject.LENGTH
    if CHECKSUM.pack(zlib.crc32(data[: -CHECKSUM.size])) != data[-CHECKSUM.size :]:
        return Reject.CHECKSUM
    if not all(map(isfinite, struct.unpack_from(f"<{3 * dimension}d", data, VECTORS_OFFSET))):
        return Reject.NON_FINITE
    return None


def reason(data: bytes, receiver: Receiver) -> Reject | None:
    """Return why the receiver ignores these bytes, its peer not silent; None if it takes them."""
    damaged = reason_in_bytes(data)
    if damaged is not None:
        return damaged
    value = {name: BY_NAME[name].read(data) for name in ("site", "session", "epoch", "sequence")}
    if value["site"] != 1 - receiver.site:
        return Reject.SITE
    if value["session"] != receiver.session:
        return Reject.SESSION
    if data[DIMENSION_OFFSET] != receiver.dimension:
        return Reject.DIMENSION
    newest = receiver.newest
    if value["epoch"] != BY_NAME["epoch"].read(newest):
        return Reject.EPOCH
    gap = value["sequence"] - BY_NAME["sequence"].read(newest)
    if gap == 0:
        return Reject.DUPLICATE
    if gap < 0:
        return Reject.OUT_OF_ORDER
    if BY_NAME["stamp_ns"].read(data) <= BY_NAME["stamp_ns"].read(newest):
        return Reject.STAMP
    return None
