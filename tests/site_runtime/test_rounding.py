from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from site_runtime.rounding import rounded_down, rounded_up

POSITIVE = st.floats(1e-12, 1e12)


@given(POSITIVE, st.integers(1, 9))
def test_rounding_is_to_the_safe_side_short_and_near(value, digits):
    for rounded in (rounded_up(value, digits), rounded_down(value, digits)):
        assert len(Decimal(repr(rounded)).normalize().as_tuple().digits) <= digits
        assert rounded == pytest.approx(value, rel=10.0 ** (1 - digits))
    assert rounded_down(value, digits) <= value <= rounded_up(value, digits)


@pytest.mark.parametrize(
    ("value", "up", "down"),
    [(12.4, 12.4, 12.4), (12.41, 12.5, 12.4), (0.029951, 0.03, 0.0299), (998.5, 999.0, 998.0),
     (999.5, 1000.0, 999.0), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)],
)  # fmt: skip
def test_three_digits(value, up, down):
    assert (rounded_up(value), rounded_down(value)) == (up, down)
