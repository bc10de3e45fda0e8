"""Where the time goes between the reading of one device and the writing of the other.

A sample's way, stage by stage, out of the rows of both sites: those of the sender by the sample's
stamp, those of the receiver by the first tick that used it.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]

STAGES: Final = ("read", "control", "write", "send", "network", "hold", "use")
"""Sender: tick's start → device read → torque passed → torque written → packet handed over →
receiver: start of the tick that took it → start of the first tick to use it → torque written.

The network's stage holds the wait for the receiver's next tick, and is off by as much as the clock
offset is uncertain; the hold is the injected delay, and what a newer sample made unnecessary.
"""

LATENCY: Final = np.dtype([(name, "<i8") for name in ("stamp_ns", *STAGES, "total", "uncertainty")])
"""One sample: its stamp on the sender's clock; each stage, their sum and its uncertainty [ns]."""


def sample_latencies(sender: RowArray, receiver: RowArray) -> npt.NDArray[np.void]:
    """Return the ways (m,), dtype `LATENCY`, of all samples that reached a torque.

    Each of `sender` and `receiver` are rows of one run, in order; samples whose tick is not among
    the sender's rows are left out.
    """
    used_ns = receiver["used_stamp_ns"]
    first = np.concatenate(([True], used_ns[1:] != used_ns[:-1])) if len(used_ns) else used_ns == 0
    uses = receiver[first & (used_ns != 0) & (receiver["write_ns"] > 0)]
    place = np.searchsorted(sender["stamp_ns"], uses["used_stamp_ns"])
    known = place < len(sender)
    known[known] = sender["stamp_ns"][place[known]] == uses["used_stamp_ns"][known]
    uses, sent = uses[known], sender[place[known]]
    uses, sent = uses[sent["sent_ns"] > 0], sent[sent["sent_ns"] > 0]

    found = np.zeros(len(uses), LATENCY)
    read, step, write, left = (
        sent[name].astype(np.int64) for name in ("read_ns", "step_ns", "write_ns", "sent_ns")
    )
    # no torque was computed or written where the outputs were off
    step = np.maximum(step, read)
    write = np.maximum(write, step)
    found["stamp_ns"] = sent["stamp_ns"]
    found["read"], found["control"] = read, step - read
    found["write"], found["send"] = write - step, left - write
    sent_at_ns = sent["stamp_ns"] + left + uses["clock_offset_ns"]
    found["network"] = uses["used_arrival_ns"] - sent_at_ns
    found["hold"] = uses["stamp_ns"] - uses["used_arrival_ns"]
    found["use"] = uses["write_ns"]
    found["total"] = np.sum([found[stage] for stage in STAGES], axis=0)
    found["uncertainty"] = uses["clock_uncertainty_ns"]
    return found


def stage_percentiles_us(
    latencies: npt.NDArray[np.void], percents: Sequence[float]
) -> dict[str, FloatArray]:
    """Return of every stage and of the total the percentiles asked for [µs]; NaN of no samples."""
    if not len(latencies):
        return {name: np.full(len(percents), np.nan) for name in (*STAGES, "total")}
    return {name: np.percentile(latencies[name], percents) * 1e-3 for name in (*STAGES, "total")}
