import numpy as np

from telemetry.rows import COLUMNS, row_dtype
from telemetry.stream import RING_BATCHES, TelemetryStream, decode_batch

CHANGED = {"sequence", "stamp_ns", "time_ns", "lateness_ns", "state", "requests"}
OFF = {"cut", "torque_nm", "coupling_force_n", "force_share"}
OFF |= {"read_ns", "step_ns", "write_ns", "sent_ns"}
FAULT = 4


def stream_to(published: list[bytes], batch_rows: int = 5) -> TelemetryStream:
    return TelemetryStream(3, 2, 1, 7, 8, published.append, batch_rows)


def put_ones(stream: TelemetryStream) -> None:
    length = {"scalar": (), "joint": (3,), "task": (2,), "reason": (12,)}
    stream.put(
        **{
            name: np.ones(length[column.axis], column.format)
            for name, column in COLUMNS.items()
            if name != "sequence"
        }
    )


def repeat(stream: TelemetryStream, tick: int) -> None:
    stream.repeat_stopped(
        stamp_ns=100 + tick, time_ns=200 + tick, lateness_ns=300 + tick, state=FAULT, requests=8
    )


def test_the_newest_row_comes_again_with_the_outputs_off() -> None:
    stream = stream_to([])
    put_ones(stream)
    repeat(stream, 0)
    before, after = stream.last(2)
    for name in row_dtype(3, 2).names:
        if name == "engaged_s":
            assert np.isnan(after[name])
        elif name in OFF:
            assert np.all(after[name] == 0), name
        elif name not in CHANGED:
            assert np.array_equal(after[name], before[name]), name
    times = [int(after[name]) for name in ("stamp_ns", "time_ns", "lateness_ns")]
    assert times == [100, 200, 300]
    assert after["state"] == FAULT
    assert after["requests"] == 8


def test_a_tick_that_failed_tells_how_far_it_came_and_what_it_read() -> None:
    stream = stream_to([])
    put_ones(stream)
    stream.repeat_stopped(
        stamp_ns=1,
        time_ns=2,
        lateness_ns=3,
        state=FAULT,
        requests=0,
        read_ns=4,
        step_ns=2**32,
        reading=(np.full(3, 5.0), np.full(3, np.nan), np.full(2, 7.0)),
    )
    [row] = stream.last(1)
    assert (row["read_ns"], row["step_ns"], row["write_ns"]) == (4, 2**32 - 1, 0)
    assert row["q"].tolist() == [5.0] * 3
    assert np.isnan(row["q_dot"]).all()
    assert row["external_force_n"].tolist() == [7.0] * 2
    assert (row["torque_nm"] == 0.0).all()


def test_repeats_are_numbered_and_published_like_any_row_through_the_end_of_the_ring() -> None:
    published: list[bytes] = []
    stream = stream_to(published, batch_rows=1)
    put_ones(stream)
    for tick in range(RING_BATCHES + 3):
        repeat(stream, tick)
        stream.flush()
    rows = np.concatenate([decode_batch(payload).rows for payload in published])
    assert rows["sequence"].tolist() == list(range(RING_BATCHES + 4))
    assert rows["stamp_ns"][1:].tolist() == [100 + tick for tick in range(RING_BATCHES + 3)]
    assert (rows["q"] == 1.0).all()
    assert stream.dropped_rows == 0


def test_without_a_row_there_is_nothing_to_repeat() -> None:
    stream = stream_to([])
    repeat(stream, 0)
    assert stream.count == 0
