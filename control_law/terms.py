"""What the control law needs to know of a robot at one instant."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class Terms(Protocol):
    """The terms of (1) and (2) at (q, q̇) of a revolute serial chain, base axes, SI units.

    n joints, z task dimensions (2 or 3). C is Christoffel-consistent: Property 2 holds.
    """

    @property
    def q(self) -> FloatArray:
        """Joint positions [rad], (n,)."""

    @property
    def q_dot(self) -> FloatArray:
        """Joint velocities [rad/s], (n,)."""

    @property
    def X(self) -> FloatArray:
        """End-effector position [m], (z,)."""

    @property
    def X_dot(self) -> FloatArray:
        """End-effector velocity [m/s], (z,)."""

    @property
    def J(self) -> FloatArray:
        """Translational Jacobian, (z, n)."""

    @property
    def J_dot(self) -> FloatArray:
        """Time derivative of the Jacobian, (z, n)."""

    @property
    def J_xyz(self) -> FloatArray:
        """J and, below it, the axes that the task ignores, (3, n)."""

    @property
    def J_xyz_dot(self) -> FloatArray:
        """Time derivative of J_xyz, (3, n)."""

    @property
    def M(self) -> FloatArray:
        """Inertia matrix, (n, n)."""

    @property
    def C(self) -> FloatArray:
        """Coriolis and centrifugal matrix, (n, n)."""

    @property
    def G(self) -> FloatArray:
        """Gravity torque [N·m], (n,)."""

    @property
    def origins(self) -> FloatArray:
        """Joint centres, then the end effector [m], (n+1, 3)."""

    @property
    def origins_dot(self) -> FloatArray:
        """Velocities of the joint centres and the end effector [m/s], (n+1, 3)."""

    @property
    def axes(self) -> FloatArray:
        """Unit joint axes, (n, 3)."""

    @property
    def axes_dot(self) -> FloatArray:
        """Time derivatives of the joint axes, (n, 3)."""
