"""Memory and processor time of both daemons, late in a run beside early in it."""

import time
from collections.abc import Iterator

import numpy as np

from experiments.benchmarks.figures import Benchmark, Effort, Goal, Row, Spread
from experiments.benchmarks.sites import Sites
from experiments.benchmarks.usage import Usage, family, usage_of
from site_runtime.keys import SiteId

_SAMPLE_S = 1.0
_PARTS = 10


def measure(effort: Effort) -> Iterator[Row]:
    """Watch the sites, their recorders and metrics processes, and compare first and last tenth."""
    step_s = min(_SAMPLE_S, effort.long_run_s / (2 * _PARTS))
    samples: list[Usage] = []
    with Sites("bench-steady", options=("--metrics", "0")) as sites:
        sites.until_engaged()
        pids = [pid for site in SiteId for pid in family(sites.pid(site))]
        start_s = time.monotonic()
        for step in range(round(effort.long_run_s / step_s) + 1):
            time.sleep(max(start_s + step * step_s - time.monotonic(), 0.0))
            samples.append(usage_of(pids))
            sites.check_alive()
    tenth = len(samples) // _PARTS
    memory_mb = np.array([sample.resident_bytes for sample in samples]) * 1e-6
    cpu_percent = np.diff([sample.cpu_s for sample in samples]) / step_s * 100.0
    duration = f"{effort.long_run_s:.0f} s"
    yield _row("memory", "MB", memory_mb, tenth, duration, len(pids))
    yield _row("processor", "% of a core", cpu_percent, tenth, duration, len(pids))


def _row(
    what: str, unit: str, values: np.ndarray, tenth: int, duration: str, processes: int
) -> Row:
    early, late = Spread.of(values[:tenth]), Spread.of(values[-tenth:])
    mean_ratio = float(np.mean(values[-tenth:]) / np.mean(values[:tenth]))
    return Row(
        what=f"{what} of both daemons, with recorders and metrics, in the last tenth of {duration}",
        against="the first tenth",
        unit=unit,
        ours=late,
        yardstick=early,
        goals=(Goal("flat: mean", mean_ratio, 1.05, 1.02),),
        notes=(f"{processes} processes together",),
    )


STEADY = Benchmark("steady", "memory and processor time over ten minutes", measure)
