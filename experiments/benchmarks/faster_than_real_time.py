"""`farhand simulate` beside real time and beside the same loop by hand, as rows of the page."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.benchmarks.figures import (
    Benchmark,
    BenchmarkError,
    Effort,
    Goal,
    Row,
    Spread,
)
from experiments.benchmarks.simulation import SimulationFigures, simulation_figures

_PAPER = Path(__file__).resolve().parents[1] / "paper_free.toml"
_LEAST_S = 30.0  # beside it the start, which is subtracted, must not weigh
_MOST_TURNS = 5


def measure(effort: Effort) -> Iterator[Row]:
    """Simulate the paper's session in turns with the loop by hand."""
    try:
        figures = simulation_figures(
            _PAPER, max(effort.seconds, _LEAST_S), min(effort.turns, _MOST_TURNS)
        )
    except RuntimeError as error:
        raise BenchmarkError(str(error)) from error
    yield row_of(figures)


def row_of(figures: SimulationFigures) -> Row:
    """Return them as a row."""
    ours, by_hand = (
        Spread.of(1e3 * np.array(s_per_s))
        for s_per_s in (figures.farhand_s_per_s, figures.by_hand_s_per_s)
    )
    return Row(
        what=f"farhand simulate {figures.session}.toml, a session second on one core",
        against="the same arms, delays and controllers by hand on numpy and MuJoCo",
        unit="ms",
        ours=ours,
        yardstick=by_hand,
        goals=(
            Goal("times real time", 1e3 / ours.p50, 10.0, 25.0, at_least=True),
            Goal("beside MuJoCo, p50", ours.over(by_hand)[0], 1.0, 1.0),
        ),
        notes=(
            f"processor time, start excluded; with it {figures.times_real_time:.1f} times real "
            f"time over {figures.duration_s:g} s, by hand {figures.by_hand_times_real_time:.1f}",
        ),
    )


SIMULATE = Benchmark("simulate", "farhand simulate, real time and a loop by hand", measure)
