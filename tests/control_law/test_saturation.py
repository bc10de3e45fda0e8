import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from control_law.saturation import Arctangent

widths = st.floats(1e-3, 1e3)
slopes = st.floats(1e-3, 1.0)
errors = st.floats(-1e4, 1e4)


def one(width: float, slope: float) -> Arctangent:
    return Arctangent(np.array([width * slope]), np.array([width]))


@given(widths, slopes, errors)
def test_is_odd_through_the_origin(width: float, slope: float, x: float) -> None:
    p = one(width, slope)
    assert p(np.array([-x])) == -p(np.array([x]))
    assert p(np.zeros(1)) == 0.0


@given(widths, slopes, st.floats(-1e2, 1e2), st.floats(1e-3, 10.0))
def test_is_strictly_increasing(
    width: float, slope: float, x_widths: float, step_widths: float
) -> None:
    p, x = one(width, slope), np.array([x_widths * width])
    assert p(x + step_widths * width) > p(x)


@given(widths, slopes, errors)
def test_is_bounded(width: float, slope: float, x: float) -> None:
    p = one(width, slope)
    assert abs(p(np.array([x]))) <= p.bound
    assert p(np.array([1e9 * width])) > (1 - 1e-8) * p.bound


@given(widths, slopes, st.floats(0, 1e2), st.floats(0, 1e2))
def test_is_concave_for_positive_errors(width: float, slope: float, a: float, b: float) -> None:
    p, a, b = one(width, slope), np.array([a * width]), np.array([b * width])
    chord = 0.5 * (p(a) + p(b))
    assert p(0.5 * (a + b)) >= chord - 1e-14 * p.bound


@given(widths, slopes, errors)
def test_never_exceeds_the_error(width: float, slope: float, x: float) -> None:
    x_ = np.array([x])
    assert abs(one(width, slope)(x_)) <= abs(x_) * (1 + 1e-15)


@given(widths, slopes, st.floats(-1e2, 1e2))
def test_derivative_and_integral_are_those_of_p(
    width: float, slope: float, x_widths: float
) -> None:
    p, x, h = one(width, slope), np.array([x_widths * width]), 1e-5 * width
    np.testing.assert_allclose(
        (p(x + h) - p(x - h)) / (2 * h), p.derivative(x), rtol=1e-5, atol=1e-9
    )
    np.testing.assert_allclose(
        (p.integral(x + h) - p.integral(x - h)) / (2 * h), p(x), rtol=1e-5, atol=1e-7 * p.bound[0]
    )
    assert p.derivative(np.zeros(1)) == p.slope
    assert (p.derivative(x) <= p.slope).all()


def test_the_papers_choice() -> None:
    p = Arctangent.paper(np.array([1.0, 0.5]))
    np.testing.assert_allclose(p(np.array([1.0, -1.0])), [np.pi / 4, -np.pi / 8])
    np.testing.assert_allclose(p.bound, [np.pi / 2, np.pi / 4])


@pytest.mark.parametrize(
    ("amplitude", "width", "message"),
    [([1.001], [1.0], "slope"), ([0.0], [1.0], "amplitude"), ([1.0], [-1.0], "width"),
     ([np.nan], [1.0], "amplitude"), ([1.0, 1.0], [1.0], "both")],
)  # fmt: skip
def test_refuses_what_breaks_a_property(
    amplitude: list[float], width: list[float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Arctangent(np.array(amplitude), np.array(width))


def test_the_papers_b_may_not_exceed_one() -> None:
    with pytest.raises(ValueError, match="slope"):
        Arctangent.paper(np.array([1.1]))
