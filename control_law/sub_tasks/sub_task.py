"""What every sub-task offers."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


class SubTask(Protocol):
    """A wish about the pose, as a joint velocity the null space may follow (Section V)."""

    def evaluate(self, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return g [rad/s] and its time derivative ġ along the motion, both (n,). Real-time safe.

        Both are fresh arrays.
        """
