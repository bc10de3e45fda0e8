import numpy as np
import pytest

from telemetry.latency import STAGES, sample_latencies, stage_percentiles_us
from telemetry.rows import RowArray, row_dtype

MS = 1_000_000
OFFSET_NS = 7_000_000_000_123
"""Put on the sender's clock it gives the receiver's."""

READ, STEP, WRITE, SENT, USE = 11_000, 211_000, 215_000, 240_000, 190_000
NETWORK_NS, HOLD_TICKS = 340_000, 30


def rows_of(count: int, start_ns: int) -> RowArray:
    rows = np.zeros(count, row_dtype(2, 2))
    rows["stamp_ns"] = start_ns + MS * np.arange(count)
    rows["read_ns"], rows["step_ns"], rows["write_ns"] = READ, STEP, WRITE
    rows["sent_ns"] = SENT
    rows["clock_uncertainty_ns"] = -1
    return rows


def exchange() -> tuple[RowArray, RowArray]:
    """Every sample takes the network's time, waits for the tick that takes it, and the hold."""
    sender, receiver = rows_of(200, 50 * MS), rows_of(300, 50 * MS + OFFSET_NS + 400_000)
    for i, row in enumerate(receiver):
        arrivals_ns = sender["stamp_ns"] + OFFSET_NS + SENT + NETWORK_NS
        ticks_ns = receiver["stamp_ns"][np.searchsorted(receiver["stamp_ns"], arrivals_ns)]
        usable = np.flatnonzero(ticks_ns <= receiver["stamp_ns"][i] - HOLD_TICKS * MS)
        if len(usable):
            row["used_stamp_ns"] = sender["stamp_ns"][usable[-1]]
            row["used_arrival_ns"] = ticks_ns[usable[-1]]
            row["clock_offset_ns"], row["clock_uncertainty_ns"] = OFFSET_NS, 5_000
    receiver["write_ns"] = USE
    return sender, receiver


def test_every_stage_is_what_it_took_and_the_sum_is_the_whole_way() -> None:
    sender, receiver = exchange()
    found = sample_latencies(sender, receiver)
    assert len(found) == 200
    expected = {
        "read": READ,
        "control": STEP - READ,
        "write": WRITE - STEP,
        "send": SENT - WRITE,
        "network": 400_000 + MS - SENT,  # 580 µs after the tick it was there: the next takes it
        "hold": HOLD_TICKS * MS,
        "use": USE,
    }
    assert tuple(expected) == STAGES
    for stage, value in expected.items():
        assert set(found[stage]) == {value}, stage
    first_use = receiver[np.searchsorted(receiver["used_stamp_ns"], found["stamp_ns"])]
    written_ns = first_use["stamp_ns"] + USE
    assert np.array_equal(found["total"], written_ns - (found["stamp_ns"] + OFFSET_NS))
    assert set(found["uncertainty"]) == {5_000}


def test_samples_that_were_overtaken_or_never_reached_a_torque_are_left_out() -> None:
    sender, receiver = exchange()
    receiver["used_stamp_ns"][100:] = receiver["used_stamp_ns"][100]
    assert sample_latencies(sender, receiver)["stamp_ns"][-1] == receiver["used_stamp_ns"][100]
    receiver["write_ns"] = 0
    assert len(sample_latencies(sender, receiver)) == 0


def test_samples_whose_tick_is_not_there_are_left_out() -> None:
    sender, receiver = exchange()
    found = sample_latencies(sender[50:90], receiver)
    assert found["stamp_ns"].tolist() == sender["stamp_ns"][50:90].tolist()
    sender["sent_ns"][60] = 0
    assert sender["stamp_ns"][60] not in sample_latencies(sender[50:90], receiver)["stamp_ns"]
    assert len(sample_latencies(sender[:0], receiver)) == 0
    assert len(sample_latencies(sender, receiver[:0])) == 0


def test_a_tick_without_outputs_spends_nothing_on_them() -> None:
    sender, receiver = exchange()
    sender["step_ns"] = sender["write_ns"] = 0
    found = sample_latencies(sender, receiver)
    assert set(found["control"]) == set(found["write"]) == {0}
    assert set(found["send"]) == {SENT - READ}


def test_percentiles_are_of_every_stage_and_of_the_whole() -> None:
    sender, receiver = exchange()
    table = stage_percentiles_us(sample_latencies(sender, receiver), (50, 99))
    assert tuple(table) == (*STAGES, "total")
    assert table["read"].tolist() == [READ / 1e3] * 2
    assert table["total"][0] == pytest.approx(sum(table[stage][0] for stage in STAGES))
    assert np.isnan(stage_percentiles_us(sample_latencies(sender[:0], receiver), (50,))["use"])
