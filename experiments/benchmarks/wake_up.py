"""How late a site wakes, beside a thread of the same policy that only sleeps."""

from collections.abc import Iterator

import numpy as np

from experiments.benchmarks.cyclic import Policy, Sleeper
from experiments.benchmarks.figures import Benchmark, Effort, Goal, Row, Spread
from experiments.benchmarks.sites import Sites
from site_runtime.keys import SiteId

_PERIOD_NS = 1_000_000


def measure(effort: Effort) -> Iterator[Row]:
    """Listen to the sites, then to the sleeper beside them, then to it alone, in turns."""
    of_sites, beside, alone = [], [], []
    with Sleeper() as sleeper:
        for _ in range(effort.turns):
            with Sites("bench-wake-up") as sites:
                sites.until_engaged()
                policy = Policy.of(sites.pid(SiteId.REMOTE))
                rows = sites.hear(effort.turn_s)
                of_sites += [rows[site]["lateness_ns"] for site in SiteId]
                beside.append(sleeper.lateness_ns(_PERIOD_NS, effort.turn_s, policy))
            alone.append(sleeper.lateness_ns(_PERIOD_NS, effort.turn_s, policy))
    ours = Spread.of(np.concatenate(of_sites) * 1e-3)
    for where, samples in (("beside both sites", beside), ("alone", alone)):
        yardstick = Spread.of(np.concatenate(samples) * 1e-3)
        p50, p99, _ = ours.over(yardstick)
        yield Row(
            what="wake-up lateness of both sites of the demo, 1 kHz",
            against=f"{sleeper.name} {where}, {policy}, the same interval",
            unit="µs",
            ours=ours,
            yardstick=yardstick,
            goals=(Goal("p50", p50, 1.5, 1.1), Goal("p99", p99, 1.5, 1.1)),
        )


WAKE_UP = Benchmark("wake-up", "how late a site wakes", measure)
