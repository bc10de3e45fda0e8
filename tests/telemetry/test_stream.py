import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.rows import (
    COLUMNS,
    LAYOUT_VERSION,
    REJECT_REASONS,
    RowArray,
    TelemetryError,
    row_dtype,
)
from telemetry.stream import RING_BATCHES, TelemetryStream, decode_batch

HEADER_BYTES = 36
DIGEST, EPOCH = 2**64 - 2, 2**63 + 5


def fields_of(tick: int, joints: int = 3, dimension: int = 2) -> dict[str, Any]:
    """Distinct, exactly representable values for every field of one tick."""
    fields: dict[str, Any] = {}
    for place, (name, column) in enumerate(COLUMNS.items()):
        if name == "sequence":
            continue
        if column.axis == "scalar":
            value = tick * 64 + place
            fields[name] = value % 200 if column.format == "u1" else value
            fields[name] = fields[name] % 60000 if column.format == "<u2" else fields[name]
        elif column.axis == "reason":
            fields[name] = [tick + reason for reason in range(len(REJECT_REASONS))]
        else:
            length = joints if column.axis == "joint" else dimension
            fields[name] = tick + place / 64 + np.arange(length) / 1024
    return fields


def stream_to(
    published: list[bytes], joints: int = 3, dimension: int = 2, batch_rows: int = 5
) -> TelemetryStream:
    return TelemetryStream(joints, dimension, 1, DIGEST, EPOCH, published.append, batch_rows)


def put(stream: TelemetryStream, ticks: Iterable[int], joints: int = 3, dimension: int = 2) -> None:
    for tick in ticks:
        stream.put(**fields_of(tick, joints, dimension))


def assert_rows_are(
    rows: RowArray, ticks: Iterable[int], joints: int = 3, dimension: int = 2
) -> None:
    ticks = list(ticks)
    assert rows["sequence"].tolist() == ticks
    for row, tick in zip(rows, ticks, strict=True):
        for name, value in fields_of(tick, joints, dimension).items():
            assert np.array_equal(row[name], value), name


@pytest.mark.parametrize(("joints", "dimension"), [(2, 2), (3, 2), (7, 3)])
def test_a_batch_reads_back_as_it_was_put(joints: int, dimension: int) -> None:
    published: list[bytes] = []
    stream = stream_to(published, joints, dimension)
    put(stream, range(5), joints, dimension)
    stream.flush()
    [payload] = published
    batch = decode_batch(payload)
    assert (batch.site, batch.joints, batch.dimension) == (1, joints, dimension)
    assert (batch.digest, batch.epoch) == (DIGEST, EPOCH)
    assert batch.rows.dtype == row_dtype(joints, dimension)
    assert not batch.rows.flags.writeable
    assert_rows_are(batch.rows, range(5), joints, dimension)


def test_fields_may_be_put_by_place_in_the_order_of_the_columns() -> None:
    stream = stream_to([])
    fields = fields_of(0)
    stream.put(*(fields[name] for name in COLUMNS if name != "sequence"))
    assert_rows_are(stream.last(1), [0])


@pytest.mark.parametrize("counter", ["lost", "late", "missed", "sent_ns"])
def test_a_counter_stays_at_the_most_it_holds(counter: str) -> None:
    """One forged packet can skip 2^64 sequence numbers; that must not stop the site."""
    stream = stream_to([])
    stream.put(**fields_of(0) | {counter: 2**64})
    stream.put(**fields_of(1) | {counter: 2**32 - 1})
    assert stream.last(2)[counter].tolist() == 2 * [2**32 - 1]


def test_flush_publishes_full_batches_only_and_drain_the_rest() -> None:
    published: list[bytes] = []
    stream = stream_to(published)
    for tick in range(13):
        put(stream, [tick])
        stream.flush()
        assert len(published) == (tick + 1) // 5
    stream.drain()
    stream.drain()
    batches = [decode_batch(payload).rows for payload in published]
    assert [len(rows) for rows in batches] == [5, 5, 3]
    assert_rows_are(np.concatenate(batches), range(13))
    put(stream, [13, 14])
    stream.flush()  # batches end where they would have ended
    assert decode_batch(published[-1]).rows["sequence"].tolist() == [13, 14]
    assert stream.dropped_rows == 0


def test_rows_after_a_drain_follow_without_gap() -> None:
    published: list[bytes] = []
    stream = stream_to(published)
    put(stream, range(7))
    stream.drain()
    put(stream, range(7, 20))
    stream.drain()
    batches = [decode_batch(payload).rows for payload in published]
    assert_rows_are(np.concatenate(batches), range(20))


def test_last_gives_copies_across_the_end_of_the_ring() -> None:
    stream = stream_to([], batch_rows=1)
    assert len(stream.last(4)) == 0
    put(stream, range(RING_BATCHES + 3))
    rows = stream.last(6)
    assert_rows_are(rows, range(RING_BATCHES - 3, RING_BATCHES + 3))
    put(stream, range(RING_BATCHES + 3, 3 * RING_BATCHES))
    assert_rows_are(rows, range(RING_BATCHES - 3, RING_BATCHES + 3))
    assert_rows_are(stream.last(10**6), range(2 * RING_BATCHES, 3 * RING_BATCHES))
    assert len(stream.last(0)) == 0


@settings(deadline=None, max_examples=30)
@given(
    batch_rows=st.integers(1, 7),
    steps=st.lists(st.tuples(st.integers(0, 700), st.sampled_from(["flush", "drain"])), max_size=6),
)
def test_what_is_published_is_in_order_and_what_is_not_is_counted(
    batch_rows: int, steps: list[tuple[int, str]]
) -> None:
    published: list[bytes] = []
    stream = stream_to(published, batch_rows=batch_rows)
    first = fields_of(0)
    for ticks, publish in steps:
        for _ in range(ticks):
            stream.put(**first)
        getattr(stream, publish)()
    stream.drain()
    sequences = [int(s) for payload in published for s in decode_batch(payload).rows["sequence"]]
    assert sequences == sorted(set(sequences))
    assert len(sequences) + stream.dropped_rows == stream.count == sum(n for n, _ in steps)
    assert all(len(decode_batch(payload).rows) <= batch_rows for payload in published)


def test_a_row_of_the_wrong_shape_is_refused_and_not_counted() -> None:
    stream = stream_to([])
    with pytest.raises(struct.error):
        stream.put(**fields_of(0) | {"q": np.zeros(4)})
    assert stream.count == 0


@pytest.mark.parametrize(
    "change",
    [{"site": 2}, {"joints": 0}, {"epoch": -1}, {"session_digest": 2**64}, {"batch_rows": 0}],
)
def test_streams_that_could_not_be_decoded_are_refused(change: dict[str, Any]) -> None:
    good = {"joints": 2, "dimension": 2, "site": 0, "session_digest": 1, "epoch": 1}
    with pytest.raises(TelemetryError):
        TelemetryStream(**good | {"publish": [].append} | change)


def good_payload() -> bytes:
    published: list[bytes] = []
    stream = stream_to(published)
    put(stream, range(5))
    stream.drain()
    return published[0]


@pytest.mark.parametrize(
    ("offset", "code", "value", "message"),
    [
        (0, "4s", b"FHTX", "not a telemetry batch"),
        (4, "B", LAYOUT_VERSION + 1, "layout version"),
        (5, "B", 2, "site 2"),
        (6, "B", 0, "0 joints"),
        (6, "B", 4, "4 joints"),
        (7, "B", 4, "4 task dimensions"),
        (8, "<I", 0, "0 rows"),
        (8, "<I", 4, "4 rows"),
        (8, "<I", 2**32 - 1, "4294967295 rows"),
        (28, "<Q", 1, "consecutively"),
        (28, "<Q", 2**64 - 1, "consecutively"),
    ],
)
def test_a_malformed_header_is_refused(offset: int, code: str, value: Any, message: str) -> None:
    payload = bytearray(good_payload())
    struct.pack_into(code, payload, offset, value)
    with pytest.raises(TelemetryError, match=message):
        decode_batch(bytes(payload))


@settings(deadline=None)
@given(cut=st.integers(0, HEADER_BYTES + 5 * row_dtype(3, 2).itemsize - 1))
def test_a_truncated_batch_is_refused(cut: int) -> None:
    with pytest.raises(TelemetryError):
        decode_batch(good_payload()[:cut])


@settings(deadline=None)
@given(extra=st.binary(min_size=1, max_size=300))
def test_a_batch_with_bytes_to_spare_is_refused(extra: bytes) -> None:
    with pytest.raises(TelemetryError):
        decode_batch(good_payload() + extra)


@settings(deadline=None)
@given(payload=st.binary(max_size=400))
def test_noise_is_refused(payload: bytes) -> None:
    with pytest.raises(TelemetryError):
        decode_batch(payload)


@settings(deadline=None)
@given(header=st.binary(min_size=HEADER_BYTES - 5, max_size=HEADER_BYTES - 5))
def test_noise_behind_a_good_magic_is_refused_or_a_batch(header: bytes) -> None:
    body = good_payload()[HEADER_BYTES:]
    try:
        batch = decode_batch(b"FHTB" + bytes([LAYOUT_VERSION]) + header + body)
    except TelemetryError:
        return
    assert batch.rows.dtype == row_dtype(batch.joints, batch.dimension)
