"""Bytes that somebody made: a packet that says the same again, or the reason of docs/packet.md."""

import struct

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.packet import MAGIC, VERSION, PacketError, Reject, decode
from tests.fuzz.layout import (
    CHECKSUM,
    DIMENSION_OFFSET,
    FIELDS,
    SIZES,
    VECTORS_OFFSET,
    VERSION_OFFSET,
    Field,
    example,
    overwritten,
    reencoded,
    resealed,
)
from tests.fuzz.reference import reason_in_bytes

dimensions = st.sampled_from(sorted(SIZES))
finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def packets(draw: st.DrawFn) -> bytes:
    z = draw(dimensions)
    values = {field.name: draw(st.integers(field.least, field.most)) for field in FIELDS}
    vectors = np.array(draw(st.lists(finite, min_size=3 * z, max_size=3 * z))).reshape(3, z)
    return example(vectors=vectors, **values)


def outcome(data: bytes) -> Reject | None:
    """Why `decode` refuses the bytes; None for a packet, which must mean these very bytes."""
    try:
        packet = decode(data)
    except PacketError as error:
        return error.reason
    assert reencoded(packet) == data
    return None


def check(data: bytes) -> None:
    assert outcome(data) is reason_in_bytes(data)


def test_the_fields_fill_the_header() -> None:
    """What these tests know of the layout is all of it: no byte is left unmutated."""
    ends = {field.offset: field.offset + struct.calcsize(field.format) for field in FIELDS}
    ends |= {
        0: len(MAGIC),
        VERSION_OFFSET: VERSION_OFFSET + 1,
        DIMENSION_OFFSET: DIMENSION_OFFSET + 1,
    }
    place = 0
    while place < VECTORS_OFFSET:
        place = ends[place]
    assert place == VECTORS_OFFSET
    assert {z: VECTORS_OFFSET + 24 * z + CHECKSUM.size for z in SIZES} == SIZES


@settings(deadline=None)
@given(packets())
def test_every_valid_packet_means_its_own_bytes(data: bytes) -> None:
    assert outcome(data) is None


@settings(deadline=None)
@given(st.binary(max_size=2 * max(SIZES.values())))
def test_any_bytes(data: bytes) -> None:
    check(data)


@settings(deadline=None)
@given(dimensions, st.data())
def test_any_bytes_behind_a_good_prefix_with_a_good_checksum(z: int, data: st.DataObject) -> None:
    size = SIZES[z]
    noise = data.draw(st.binary(min_size=size, max_size=size))
    noise = overwritten(noise, 0, MAGIC + bytes([VERSION]))
    check(resealed(overwritten(noise, DIMENSION_OFFSET, bytes([z]))))


@settings(deadline=None)
@given(packets(), st.lists(st.integers(0, 10**6), min_size=1, max_size=16), st.booleans())
def test_flipped_bits(data: bytes, places: list[int], seal: bool) -> None:
    mutated = bytearray(data)
    for place in places:
        mutated[place // 8 % len(data)] ^= 1 << place % 8
    check(resealed(bytes(mutated)) if seal else bytes(mutated))


@settings(deadline=None)
@given(packets(), st.integers(0, max(SIZES.values())), st.binary(max_size=64), st.booleans())
def test_cut_and_extended(data: bytes, length: int, tail: bytes, seal: bool) -> None:
    mutated = data[:length] + tail
    check(resealed(mutated) if seal and len(mutated) > CHECKSUM.size else mutated)


@settings(deadline=None)
@given(packets(), st.sampled_from(FIELDS), st.data())
def test_an_overwritten_field(data: bytes, field: Field, draws: st.DataObject) -> None:
    value = draws.draw(st.integers(field.least, field.most))
    forged = field.written(data, value)
    assert outcome(forged) is (None if forged == data else Reject.CHECKSUM)
    assert outcome(resealed(forged)) is None, "any number is a packet; judging it is the channel's"
    assert getattr(decode(resealed(forged)), field.name) == value


@settings(deadline=None)
@given(packets(), st.integers(0, 255), st.sampled_from([VERSION_OFFSET, DIMENSION_OFFSET]))
def test_an_overwritten_version_or_dimension(data: bytes, value: int, place: int) -> None:
    check(resealed(overwritten(data, place, bytes([value]))))


@settings(deadline=None)
@given(packets(), st.integers(0, 8), st.floats() | st.integers(0, 2**64 - 1))
def test_an_overwritten_vector(data: bytes, place: int, value: float) -> None:
    number = struct.pack("<d" if isinstance(value, float) else "<Q", value)
    z = data[DIMENSION_OFFSET]
    mutated = resealed(overwritten(data, VECTORS_OFFSET + 8 * (place % (3 * z)), number))
    (written,) = struct.unpack("<d", number)
    assert outcome(mutated) is (None if np.isfinite(written) else Reject.NON_FINITE)


@settings(deadline=None)
@given(packets(), packets(), st.integers(0, 200), st.integers(0, 200), st.booleans())
def test_two_packets_spliced(first: bytes, second: bytes, end: int, start: int, seal: bool) -> None:
    mutated = first[:end] + second[start:]
    check(resealed(mutated) if seal and len(mutated) > CHECKSUM.size else mutated)


@settings(deadline=None)
@given(packets(), packets())
def test_a_datagram_of_two_packets_is_none(first: bytes, second: bytes) -> None:
    assert outcome(first + second) is Reject.LENGTH
