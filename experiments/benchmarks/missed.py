"""How many ticks both sites miss at a rate, beside loops that do nothing."""

from collections.abc import Iterator

import numpy as np

from experiments.benchmarks.empty_loop import empty_loops
from experiments.benchmarks.figures import (
    Benchmark,
    BenchmarkError,
    Effort,
    Goal,
    Row,
    Spread,
    Unmeasured,
)
from experiments.benchmarks.sites import Sites
from site_runtime.session_edit import TomlValue
from site_runtime.supervisor import State
from telemetry.rows import RowArray

_WHAT = "missed ticks of both sites at {} Hz"
_PERCENT = 100.0


def measure(effort: Effort) -> Iterator[Row | Unmeasured]:
    """Run the sites, then two empty loops, in turns, at each rate."""
    for rate_hz in effort.rates_hz:
        try:
            yield _at(rate_hz, effort)
        except BenchmarkError as error:
            yield Unmeasured(_WHAT.format(rate_hz), str(error))


def _at(rate_hz: int, effort: Effort) -> Row:
    changes: dict[str, TomlValue | None] = {
        "loop.rate_hz": rate_hz,
        # so that a site which cannot keep its rate is counted rather than stopped
        "loop.late_ticks_to_hold": 10**9,
        "loop.late_ticks_to_fault": 10**9,
    }
    ours, empty, ticks_us, engaged = [], [], [], []
    turns = max(effort.turns // 2, 1)
    for _ in range(turns):
        with Sites("bench-missed", changes) as sites:
            sites.until_heard()
            for rows in sites.hear(effort.seconds / turns).values():
                ours.append(missed_share(rows))
                ticks_us.append(rows["duration_ns"] * 1e-3)
                engaged.append(rows["state"] == State.ENGAGED)
        empty += [loop.missed_share for loop in empty_loops(rate_hz, effort.seconds / turns, 2)]
    difference = _PERCENT * (float(np.mean(ours)) - float(np.mean(empty)))
    tick = Spread.of(np.concatenate(ticks_us))
    return Row(
        what=_WHAT.format(rate_hz),
        against="two empty loops of the same clock and policy at once",
        unit="%",
        ours=Spread.of(_PERCENT * np.array(ours)),
        yardstick=Spread.of(_PERCENT * np.array(empty)),
        goals=(Goal("percentage points more", difference, 0.1, 0.1),),
        notes=(
            f"a tick takes p50 {tick.p50:.0f}, p99 {tick.p99:.0f} µs of {1e6 / rate_hz:.0f}; "
            f"ENGAGED in {_PERCENT * np.mean(np.concatenate(engaged)):.1f} % of the ticks; "
            "the supervisor's late-tick limits are off",
        ),
    )


def missed_share(rows: RowArray) -> float:
    """Return the share of ticks, from the first row to the last, that the site missed."""
    # by the site's own counts: a batch of rows may have been lost on its way here
    missed, ticks = (int(rows[name][-1]) - int(rows[name][0]) for name in ("missed", "sequence"))
    return missed / (missed + ticks)


MISSED = Benchmark("missed", "ticks missed at 1, 2 and 4 kHz", measure)
