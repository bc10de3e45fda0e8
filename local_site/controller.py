"""The local robot's law: (6) with ζ = 0, τ = G − JᵀΩP(e) − Λq̇."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.control import control_torque
from control_law.coupling import Coupling
from control_law.damping import Damping
from hardware.robot_model import RobotTerms
from site_runtime.controller import Command

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LocalController:
    """nP+D with gravity compensation."""

    coupling: Coupling
    damping: Damping

    def step(
        self, terms: RobotTerms, peer_position_m: FloatArray, force_share: float, engaged_s: float
    ) -> Command:
        """Return the torque toward the remote robot's delayed position (z,) [m]."""
        force = force_share * self.coupling.force(terms.X - peer_position_m)  # (3), ΩP(e_l)
        zeta = np.zeros(len(terms.q))
        torque, _ = control_torque(terms, force, self.damping, zeta, zeta)
        return Command(torque, -force)
