"""Several wishes at once, and never too loud."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt

from control_law.sub_tasks.sub_task import SubTask
from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class WeightedSum:
    """g = Σ w_i g_i: the negative gradient of the weighted sum of the functions."""

    tasks: Sequence[SubTask]
    weights: Sequence[float]

    def __post_init__(self) -> None:
        if not self.tasks or len(self.tasks) != len(self.weights):
            raise ValueError(
                f"{len(self.tasks)} sub-tasks need as many weights, not {len(self.weights)}, "
                "and at least one"
            )
        if not all(weight >= 0 for weight in self.weights):
            raise ValueError(f"weights {self.weights} must be zero or more")

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n)."""
        total = self.tasks[0].evaluate(terms)
        total *= self.weights[0]
        for task, weight in zip(self.tasks[1:], self.weights[1:], strict=True):
            part = task.evaluate(terms)
            if weight != 1.0:
                part *= weight
            total += part
        return total


@dataclass(frozen=True, slots=True, eq=False)
class NormLimiter:
    """g/√(1 + ‖g‖²/g_m²): the same direction, a speed below g_m [rad/s], as smooth as g."""

    task: SubTask
    ceiling_rad_s: float

    def __post_init__(self) -> None:
        if not self.ceiling_rad_s > 0:
            raise ValueError(f"ceiling {self.ceiling_rad_s} rad/s must be positive")

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g and ġ, (2, n)."""
        wish = self.task.evaluate(terms)
        (g2, g_g_dot), _ = wish.dot(wish.T).tolist()
        inverse = 1.0 / (self.ceiling_rad_s * self.ceiling_rad_s)
        scale = 1.0 / sqrt(1.0 + g2 * inverse)
        return ramped(wish, (scale, -(scale**3) * g_g_dot * inverse))


def ramped(wish: FloatArray, ramp: tuple[float, float]) -> FloatArray:
    """Return r·g and r·ġ + ṙ·g, (2, n), for g and ġ, (2, n), and a factor r with its rate ṙ."""
    value, rate = ramp
    if value == 1.0 and rate == 0.0:
        return wish
    result: FloatArray = np.array(((value, 0.0), (rate, value))).dot(wish)
    return result
