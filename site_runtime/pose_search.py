"""The pose where damping weighs most against inertia, searched for over an arm's whole range."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law import sampling
from control_law.damping import Damping
from hardware.robot_model import RobotModel

FloatArray = npt.NDArray[np.float64]

POSES = 2000
_STEPS_RAD = 0.5 * 0.7 ** np.arange(16)


@dataclass(frozen=True, slots=True)
class FastestMode:
    """The greatest λ_max(M⁻¹Λ) [1/s] that a search found, and the pose [rad]."""

    rate_per_s: float
    pose_rad: tuple[float, ...]


class PoseSearch:
    """Seeded random poses of one robot, the worst of them refined joint by joint.

    It finds a lower bound of the supremum, as any search does.
    """

    def __init__(self, robot: RobotModel, seed: int) -> None:
        self._robot = robot
        # A joint without limits turns all the way.
        lower, upper = (
            np.where(np.isfinite(limit), limit, side * np.pi)
            for limit, side in zip(robot.position_limits_rad, (-1.0, 1.0), strict=True)
        )
        self._range = lower, upper
        self._poses = np.random.default_rng(seed).uniform(lower, upper, (POSES, robot.joints))
        terms = [robot.terms(pose, np.zeros(robot.joints)) for pose in self._poses]
        self._J = np.array([at.J for at in terms])
        self._roots = np.linalg.inv(np.linalg.cholesky(np.array([at.M for at in terms])))
        self._J_roots = self._J @ self._roots.mT

    def fastest(self, damping: Damping) -> FastestMode:
        """Return the fastest damped mode found."""
        pose = self._poses[int(self._rates(damping).argmax())]
        rate = self._rate(pose, damping)
        for step in _STEPS_RAD:
            for joint in range(self._robot.joints):
                for side in (-step, step):
                    near = pose.copy()
                    near[joint] += side
                    near = np.clip(near, *self._range)
                    near_rate = self._rate(near, damping)
                    if near_rate > rate:
                        pose, rate = near, near_rate
        return FastestMode(rate, tuple(pose.tolist()))

    def joint_drag(self, joint_nm_s: FloatArray) -> float:
        """Return what joint damping (n,) adds to the drag at the end effector [N·s/m].

        In the direction that feels it most, (JΛ⁻¹Jᵀ)⁻¹, in the median pose.
        """
        mobility = (self._J / joint_nm_s) @ self._J.mT
        return float(1.0 / np.median(np.linalg.eigvalsh(mobility)[:, 0]))

    def _rates(self, damping: Damping) -> FloatArray:
        in_joints = (self._roots * damping.joint) @ self._roots.mT
        along_axes = (self._J_roots.mT * damping.task) @ self._J_roots
        rates: FloatArray = np.linalg.eigvalsh(in_joints + along_axes)[:, -1].astype(np.float64)
        return rates

    def _rate(self, pose: FloatArray, damping: Damping) -> float:
        terms = self._robot.terms(pose, np.zeros(self._robot.joints))
        return sampling.damping_ratio(1.0, terms.M, damping.matrix(terms.J))
