"""What every sub-task offers."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from control_law.terms import Terms

FloatArray = npt.NDArray[np.float64]


class SubTask(Protocol):
    """A wish about the pose, as a joint velocity the null space may follow (Section V)."""

    def evaluate(self, terms: Terms) -> FloatArray:
        """Return g [rad/s] and its time derivative ġ along the motion, (2, n). Real-time safe.

        A fresh array, the caller's to change.
        """
