"""A smooth way from nothing to everything."""


def smooth_ramp(elapsed_s: float, duration_s: float) -> tuple[float, float]:
    """Return a value that goes from 0 to 1 with two continuous derivatives, and its rate [1/s].

    A quintic over the duration; a duration of 0 is already there.
    """
    if elapsed_s >= duration_s:
        return 1.0, 0.0
    if elapsed_s <= 0.0:
        return 0.0, 0.0
    x = elapsed_s / duration_s
    value = min(x * x * x * (10.0 + x * (6.0 * x - 15.0)), 1.0)  # else 1 + 1e-16 near the end
    rate = 30.0 * (x * (1.0 - x)) ** 2 / duration_s
    return value, rate
