"""One tick of the remote site beside what it cannot avoid, as a row of the page."""

from collections.abc import Iterator

from experiments.benchmarks.figures import Benchmark, BenchmarkError, Effort, Goal, Row, Spread
from experiments.benchmarks.tick import TickFigures, tick_figures
from hardware.interface import FloatArray


def measure(effort: Effort) -> Iterator[Row]:
    """Measure the tick and its floor in turns."""
    try:
        figures = tick_figures(effort.seconds)
    except RuntimeError as error:
        raise BenchmarkError(str(error)) from error
    yield row_of(figures)


def row_of(figures: TickFigures) -> Row:
    """Return them as a row."""
    ours, floor = (_spread(values, figures.ticks) for values in (figures.tick_us, figures.floor_us))
    return Row(
        what="one tick of the remote site, four joints and two sub-tasks, its plant excluded",
        against="pinocchio's calls and the one Zenoh put, alone, cold at 1 kHz",
        unit="µs",
        ours=ours,
        yardstick=floor,
        goals=(Goal("p50", ours.over(floor)[0], 2.5, 1.5),),
        notes=(f"{figures.missed} ticks missed",),
    )


def _spread(percentiles: FloatArray, count: int) -> Spread:
    p50, p99, p999 = map(float, percentiles)
    return Spread(p50, p99, p999, count)


SITE_TICK = Benchmark("tick", "one site tick beside what it cannot avoid", measure)
