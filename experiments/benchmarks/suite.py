"""All benchmarks, in the order of the page, and a run of some of them."""

import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

from experiments.benchmarks.faster_than_real_time import SIMULATE
from experiments.benchmarks.figures import Benchmark, BenchmarkError, Effort, Row, Unmeasured
from experiments.benchmarks.hand_to_hand import HAND_TO_HAND
from experiments.benchmarks.machine import describe_machine
from experiments.benchmarks.missed import MISSED
from experiments.benchmarks.pairs import PAIRS
from experiments.benchmarks.site_tick import SITE_TICK
from experiments.benchmarks.steady import STEADY
from experiments.benchmarks.telemetry import TELEMETRY
from experiments.benchmarks.wake_up import WAKE_UP
from site_runtime.doctor_machine import load, processor_times

BENCHMARKS: tuple[Benchmark, ...] = (
    SITE_TICK,
    TELEMETRY,
    WAKE_UP,
    MISSED,
    HAND_TO_HAND,
    SIMULATE,
    STEADY,
    PAIRS,
)


@dataclass(frozen=True, slots=True)
class Page:
    """What a run found: by what command, the machine, its lines in order, how long it took [s]."""

    command: str
    machine: dict[str, str]
    rows: tuple[Row | Unmeasured, ...]
    took_s: float


def run(
    benchmarks: Iterable[Benchmark],
    effort: Effort,
    command: str,
    begins: Callable[[Benchmark], None],
) -> Page:
    """Run benchmarks one after the other; what cannot be measured is a line that says why."""
    machine = describe_machine()
    start_s, before = time.monotonic(), processor_times()
    machine["measured"] = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    rows: list[Row | Unmeasured] = []
    for benchmark in benchmarks:
        begins(benchmark)
        rows += _rows(benchmark, effort)
    machine["load"] = load(before).measured
    return Page(command, machine, tuple(rows), time.monotonic() - start_s)


def _rows(benchmark: Benchmark, effort: Effort) -> list[Row | Unmeasured]:
    rows: list[Row | Unmeasured] = []
    try:
        rows.extend(benchmark.measure(effort))
    except BenchmarkError as error:
        rows.append(Unmeasured(benchmark.what, str(error)))
    except Exception as error:  # half an hour of other figures must not be lost with this one
        traceback.print_exc()
        rows.append(Unmeasured(benchmark.what, f"failed: {type(error).__name__}: {error}"))
    return rows
