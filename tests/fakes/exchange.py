"""Rows of two sites whose samples all take the same way, in the same time."""

import numpy as np

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
