"""The remote robot's law: (4)–(6) with a sub-task in the null space of its Jacobian."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt

from control_law.control import control_torque
from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.null_space import null_space_velocity, project
from control_law.ramp import smooth_ramp
from control_law.sub_tasks.composite import ramped
from control_law.sub_tasks.sub_task import SubTask
from hardware.robot_model import RobotTerms
from site_runtime.controller import Command

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RemoteController:
    """nP+D with gravity compensation; the sub-task ramps in after engagement [s]."""

    coupling: Coupling
    damping: Damping
    sub_task: SubTask | None
    sub_task_ramp_s: float
    regularisation: float

    def step(
        self, terms: RobotTerms, peer_position_m: FloatArray, force_share: float, engaged_s: float
    ) -> Command:
        """Return the torque toward the local robot's delayed position (z,) [m]."""
        force = force_share * self.coupling.force(terms.X - peer_position_m)  # (3), ΩP(e_r)
        zeta, zeta_dot = self.reference(terms, engaged_s)
        torque, s = control_torque(terms, force, self.damping, zeta, zeta_dot)  # (6)
        error_rad_s = 0.0
        if self.sub_task is not None:
            error = project(terms.J, s, self.regularisation)  # (21)
            error_rad_s = sqrt(error.dot(error))
        return Command(torque, -force, error_rad_s)

    def reference(self, terms: RobotTerms, engaged_s: float) -> tuple[FloatArray, FloatArray]:
        """Return ζ and ζ̇ of (4), (n,): the sub-task's gradient, ramped in, in the null space."""
        if self.sub_task is None:
            rest = np.zeros(len(terms.q))
            return rest, rest
        ramp = smooth_ramp(engaged_s, self.sub_task_ramp_s)
        g, g_dot = ramped(self.sub_task.evaluate(terms), ramp)
        return null_space_velocity(terms.J, terms.J_dot, g, g_dot, self.regularisation)
