"""Percentiles, goals and verdicts."""

from math import inf, isnan, nan

import numpy as np
import pytest

from experiments.benchmarks.figures import (
    BenchmarkError,
    Goal,
    Row,
    Spread,
    Unmeasured,
    Verdict,
)


def row(*goals: Goal) -> Row:
    one = Spread.of([1.0])
    return Row("what", "against", "µs", one, one, goals)


def test_a_spread_counts_and_orders_its_samples() -> None:
    spread = Spread.of(np.arange(10001.0))
    assert spread.percentiles == pytest.approx((5000.0, 9900.0, 9990.0))
    assert spread.count == 10001


def test_a_ratio_is_taken_percentile_by_percentile_and_of_nothing_is_none() -> None:
    ratios = Spread(2.0, 9.0, 1.0, 5).over(Spread(4.0, 3.0, 0.0, 5))
    assert ratios[:2] == (0.5, 3.0)
    assert isnan(ratios[2])


def test_without_samples_there_is_no_spread() -> None:
    with pytest.raises(BenchmarkError, match="no samples"):
        Spread.of([])


@pytest.mark.parametrize(
    ("value", "at_least", "verdict"),
    [
        (1.0, False, Verdict.FURTHER),
        (1.5, False, Verdict.FURTHER),
        (1.51, False, Verdict.REACHED),
        (2.5, False, Verdict.REACHED),
        (2.51, False, Verdict.MISSED),
        (nan, False, Verdict.MISSED),
        (-inf, False, Verdict.MISSED),
    ],
)
def test_a_goal_to_stay_below(value: float, at_least: bool, verdict: Verdict) -> None:
    assert Goal("", value, 2.5, 1.5, at_least).verdict is verdict


@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        (9.9, Verdict.MISSED),
        (10.0, Verdict.REACHED),
        (24.9, Verdict.REACHED),
        (25.0, Verdict.FURTHER),
        (inf, Verdict.MISSED),
    ],
)
def test_a_goal_to_come_up_to(value: float, verdict: Verdict) -> None:
    assert Goal("", value, 10.0, 25.0, at_least=True).verdict is verdict


def test_a_row_is_as_good_as_the_worst_of_its_goals() -> None:
    further, reached, missed = (Goal("", value, 2.0, 1.0) for value in (0.5, 1.5, 3.0))
    assert row(further, missed, reached).verdict is Verdict.MISSED
    assert row(further, reached).verdict is Verdict.REACHED
    assert row(further).verdict is Verdict.FURTHER
    assert row().verdict is Verdict.STATED
    assert not hasattr(Unmeasured("what", "why"), "verdict")
