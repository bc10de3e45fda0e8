import numpy as np
import pytest

from control_law.ramp import smooth_ramp


def test_goes_from_nothing_to_everything() -> None:
    assert smooth_ramp(-1.0, 2.0) == (0.0, 0.0)
    assert smooth_ramp(0.0, 2.0) == (0.0, 0.0)
    assert smooth_ramp(1.0, 2.0)[0] == pytest.approx(0.5)
    assert smooth_ramp(2.0, 2.0) == (1.0, 0.0)
    assert smooth_ramp(9.0, 2.0) == (1.0, 0.0)


def test_without_duration_it_is_already_there() -> None:
    assert smooth_ramp(0.0, 0.0) == (1.0, 0.0)


def test_rises_and_its_rate_is_its_derivative() -> None:
    times, h = np.linspace(-0.1, 2.1, 221), 1e-6
    rates = np.array([smooth_ramp(t, 2.0)[1] for t in times])
    differences = [
        (smooth_ramp(t + h, 2.0)[0] - smooth_ramp(t - h, 2.0)[0]) / (2 * h) for t in times
    ]
    np.testing.assert_allclose(rates, differences, atol=1e-9)
    assert (rates >= 0).all()


def test_two_derivatives_are_continuous_at_the_ends() -> None:
    for end, inside in ((0.0, 1e-6), (2.0, 2.0 - 1e-6)):
        assert smooth_ramp(inside, 2.0)[1] == pytest.approx(smooth_ramp(end, 2.0)[1], abs=1e-9)


def test_a_ramp_never_exceeds_one_by_rounding() -> None:
    for duration_s in (0.05, np.nextafter(0.05, 1.0), 0.2, 1.0, 3.0):
        for left in np.geomspace(1e-16, 1.0, 2000):
            assert 0.0 <= smooth_ramp(duration_s * (1.0 - left), duration_s)[0] <= 1.0
