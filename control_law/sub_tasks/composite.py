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

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,)."""
        g = np.zeros_like(terms.q)
        g_dot = np.zeros_like(terms.q)
        for task, weight in zip(self.tasks, self.weights, strict=True):
            part, part_dot = task.evaluate(terms)
            g += weight * part
            g_dot += weight * part_dot
        return g, g_dot


@dataclass(frozen=True, slots=True, eq=False)
class NormLimiter:
    """g/√(1 + ‖g‖²/g_m²): the same direction, a speed below g_m [rad/s], as smooth as g."""

    task: SubTask
    ceiling_rad_s: float

    def __post_init__(self) -> None:
        if not self.ceiling_rad_s > 0:
            raise ValueError(f"ceiling {self.ceiling_rad_s} rad/s must be positive")

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g and ġ, (n,)."""
        g, g_dot = self.task.evaluate(terms)
        inverse = 1.0 / (self.ceiling_rad_s * self.ceiling_rad_s)
        scale = 1.0 / sqrt(1.0 + float(g.dot(g)) * inverse)
        scale_dot = -(scale**3) * float(g.dot(g_dot)) * inverse
        return scale * g, scale * g_dot + scale_dot * g


def ramped(
    g: FloatArray, g_dot: FloatArray, ramp: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Return r·g and r·ġ + ṙ·g, (n,), for a ramp (r, ṙ) as `smooth_ramp` gives it."""
    value, rate = ramp
    return value * g, value * g_dot + rate * g
