import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.measures import settling_time_s


@pytest.mark.parametrize(
    ("errors_m", "expected_s"),
    [
        ([3.0, 2.0, 1.0, 0.5], 2.0),
        ([3.0, 0.5, 2.0, 0.5], 3.0),
        ([1.0, 0.9], 0.0),
        ([0.5, 2.0], None),
        ([2.0, 2.0], None),
    ],
    ids=["falls", "comes back up once", "never above", "ends above", "always above"],
)
def test_the_error_has_settled_when_it_stays_within_the_limit(
    errors_m: list[float], expected_s: float | None
) -> None:
    time_s = np.arange(len(errors_m), dtype=float)
    assert settling_time_s(time_s, np.array(errors_m), 1.0) == expected_s


@given(errors_m=st.lists(st.floats(0.0, 2.0), min_size=1, max_size=30))
def test_from_then_on_it_is_within_and_not_earlier(errors_m: list[float]) -> None:
    time_s, error_m = 5.0 + np.arange(len(errors_m)), np.array(errors_m)
    settled_s = settling_time_s(time_s, error_m, 1.0)
    if settled_s is None:
        assert error_m[-1] > 1.0
        return
    assert (error_m[time_s >= settled_s] <= 1.0).all()
    assert settled_s == time_s[0] or error_m[time_s < settled_s][-1] > 1.0
