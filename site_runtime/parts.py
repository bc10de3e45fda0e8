"""The parts of a site that a session file describes: robot, coupling, damping, limits."""

from math import inf

import numpy as np
import numpy.typing as npt

from control_law.coupling import Coupling
from control_law.damping import Damping
from hardware.robot_model import RobotModel, build_robot
from site_runtime.guard import Limits
from site_runtime.keys import SiteId
from site_runtime.session import (
    CouplingSettings,
    DampingSettings,
    LimitSettings,
    PaperCoupling,
    Session,
)

FloatArray = npt.NDArray[np.float64]


def robot_of(session: Session, site: SiteId) -> RobotModel:
    """Build the robot model of one site."""
    return build_robot(session.site(site).robot, session.path.parent)


def coupling_of(settings: CouplingSettings) -> Coupling:
    """Build ΩP."""
    if isinstance(settings, PaperCoupling):
        return Coupling.paper(np.array(settings.omega), np.array(settings.b))
    return Coupling.from_stiffness(
        np.array(settings.stiffness_n_per_m), np.array(settings.force_ceiling_n)
    )


def damping_of(settings: DampingSettings) -> Damping:
    """Build Λ of one site."""
    return Damping(np.array(settings.joint_nm_s), np.array(settings.task_n_s_per_m))


def limits_of(settings: LimitSettings, joints: int, dimension: int) -> Limits:
    """Build the guard's limits; what the file leaves out is unlimited."""

    def vector(values: tuple[float, ...] | None, length: int, absent: float) -> FloatArray:
        return np.full(length, absent) if values is None else np.array(values)

    return Limits(
        torque_nm=vector(settings.torque_nm, joints, inf),
        velocity_rad_s=vector(settings.velocity_rad_s, joints, inf),
        workspace_min_m=vector(settings.workspace_min_m, dimension, -inf),
        workspace_max_m=vector(settings.workspace_max_m, dimension, inf),
    )
