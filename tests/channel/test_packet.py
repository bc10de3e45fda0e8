import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.packet import NO_STAMP, VERSION, Packet, PacketError, Reject, decode, encode

u8 = st.integers(0, 2**8 - 1)
u64 = st.integers(0, 2**64 - 1)
i64 = st.integers(-(2**63), 2**63 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.sampled_from([2, 3]).flatmap(
    lambda z: st.lists(finite, min_size=3 * z, max_size=3 * z).map(
        lambda values: np.array(values).reshape(3, z)
    )
)
fields = st.fixed_dictionaries(
    {
        "site": u8,
        "state": u8,
        "session": u64,
        "epoch": u64,
        "sequence": u64,
        "stamp_ns": i64,
        "echo_epoch": u64,
        "echo_stamp_ns": i64,
        "echo_arrival_ns": i64,
        "used_stamp_ns": i64,
        "greatest_age_ns": i64,
    }
)


def example(dimension: int = 3) -> bytes:
    return encode(
        site=1,
        state=2,
        session=0x0807060504030201,
        epoch=4,
        sequence=5,
        stamp_ns=6,
        echo_epoch=7,
        echo_stamp_ns=8,
        echo_arrival_ns=9,
        used_stamp_ns=NO_STAMP,
        greatest_age_ns=0,
        vectors=np.arange(3.0 * dimension).reshape(3, dimension),
    )


def resealed(data: bytes) -> bytes:
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def with_float(offset: int, value: float) -> bytes:
    return resealed(example()[:offset] + struct.pack("<d", value) + example()[offset + 8 :])


@settings(deadline=None)
@given(fields, vectors)
def test_what_is_encoded_is_decoded(values: dict[str, int], floats: np.ndarray) -> None:
    packet = decode(encode(vectors=floats, **values))
    assert {key: getattr(packet, key) for key in values} == values
    np.testing.assert_array_equal(packet.position_m, floats[0])
    np.testing.assert_array_equal(packet.velocity_m_s, floats[1])
    np.testing.assert_array_equal(packet.force_n, floats[2])
    assert packet.position_m.dtype == np.float64


def test_layout_is_the_documented_one() -> None:
    data = example(dimension=2)
    assert len(data) == 132
    assert data[:16] == b"FARH" + bytes([VERSION, 1, 2, 2]) + bytes(range(1, 9))
    assert struct.unpack_from("<QQqQqqqq", data, 16) == (4, 5, 6, 7, 8, 9, -1, 0)
    assert struct.unpack_from("<6d", data, 80) == (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
    assert struct.unpack_from("<I", data, 128) == (zlib.crc32(data[:128]),)
    assert len(example(dimension=3)) == 156


def test_decoded_vectors_are_read_only() -> None:
    with pytest.raises(ValueError, match="read-only"):
        decode(example()).position_m[0] = 1.0


def only_a_packet_or_a_packet_error(data: bytes) -> Packet | Reject:
    try:
        return decode(data)
    except PacketError as error:
        return error.reason


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    assert isinstance(only_a_packet_or_a_packet_error(data), Reject)


@settings(deadline=None)
@given(st.integers(0, 147), st.integers(1, 255), st.sampled_from([2, 3]))
def test_no_changed_byte_goes_unnoticed(place: int, change: int, dimension: int) -> None:
    data = bytearray(example(dimension))
    data[place % len(data)] ^= change
    assert isinstance(only_a_packet_or_a_packet_error(bytes(data)), Reject)


@settings(deadline=None)
@given(st.integers(0, 147))
def test_no_cut_packet_is_accepted(length: int) -> None:
    assert isinstance(only_a_packet_or_a_packet_error(example()[:length]), Reject)


@settings(deadline=None)
@given(st.integers(0, 147), st.integers(0, 255))
def test_a_resealed_mutation_is_a_packet_or_refused(place: int, value: int) -> None:
    data = bytearray(example())
    data[place] = value
    outcome = only_a_packet_or_a_packet_error(resealed(bytes(data)))
    if isinstance(outcome, Packet):
        assert np.isfinite(outcome.position_m).all()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", Reject.LENGTH),
        (example()[:79], Reject.LENGTH),
        (example() + b"\0", Reject.LENGTH),
        (b"PICK" + example()[4:], Reject.MAGIC),
        (b"FARH" + bytes([VERSION + 1]) + example()[5:], Reject.VERSION),
        (example()[:7] + b"\4" + example()[8:], Reject.DIMENSION),
        (example()[:7] + b"\2" + example()[8:], Reject.LENGTH),
        (example()[:-1] + bytes([example()[-1] ^ 1]), Reject.CHECKSUM),
        (resealed(example()[:80] + struct.pack("<d", np.nan) + example()[88:]), Reject.NON_FINITE),
        (
            resealed(example()[:136] + struct.pack("<d", np.inf) + example()[144:]),
            Reject.NON_FINITE,
        ),
    ],
)
def test_each_reason_is_named(data: bytes, reason: Reject) -> None:
    with pytest.raises(PacketError, match=reason.value) as raised:
        decode(data)
    assert raised.value.reason is reason
