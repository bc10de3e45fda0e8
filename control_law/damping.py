"""The damping Λ of (6), in the joints as printed, and along the task axes."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Damping:
    """Λ(q) = diag(joint) + Jᵀ diag(task) J.

    `joint` (n,) [N·m·s/rad], strictly positive; `task` (z,) [N·s/m], zero or more. The paper
    has joint damping only; task damping acts on Ẋ = J s, so its certificate needs no reach.
    """

    joint: FloatArray
    task: FloatArray
    _task_acts: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.joint.ndim != 1 or self.task.ndim != 1:
            raise ValueError(f"damping {self.joint.shape}, {self.task.shape} must be (n,), (z,)")
        if not (np.isfinite(self.joint).all() and (self.joint > 0).all()):
            raise ValueError(
                f"joint damping {self.joint} must be positive and finite: "
                "the null space has no other damping"
            )
        if not (np.isfinite(self.task).all() and (self.task >= 0).all()):
            raise ValueError(f"task damping {self.task} must be zero or more, and finite")
        object.__setattr__(self, "_task_acts", bool(self.task.any()))

    def apply(self, J: FloatArray, s: FloatArray) -> FloatArray:
        """Return Λ(q) s [N·m], (n,), without forming Λ."""
        torque = self.joint * s
        if self._task_acts:
            torque += (self.task * J.dot(s)).dot(J)
        return torque

    def matrix(self, J: FloatArray) -> FloatArray:
        """Return Λ(q), (n, n)."""
        return np.diag(self.joint) + (J.T * self.task) @ J
