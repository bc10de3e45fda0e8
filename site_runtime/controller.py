"""What a site asks of its controller."""

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from hardware.robot_model import RobotTerms

FloatArray = npt.NDArray[np.float64]


class Command(NamedTuple):
    """One step's result: torque (n,) [N·m] and what people want to see of it.

    `coupling_force_n` (z,) is −ΩP(e), the force that the coupling exerts on this robot.
    `sub_task_error_rad_s` is ‖STE‖ of (21), 0 without a sub-task.
    """

    torque_nm: FloatArray
    coupling_force_n: FloatArray
    sub_task_error_rad_s: float = 0.0


class Controller(Protocol):
    """The paper's law at one site; pure but for its constants."""

    def step(
        self, terms: RobotTerms, peer_position_m: FloatArray, force_share: float, engaged_s: float
    ) -> Command:
        """Return the command at (q, q̇) toward the peer's point, `engaged_s` after engagement.

        `force_share`, 0 to 1, scales ΩP.
        """
        ...
