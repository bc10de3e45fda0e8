"""The parts of a site that a session file describes: robot, coupling, damping, limits."""

from math import inf

import numpy as np
import numpy.typing as npt

from control_law.coupling import Coupling
from control_law.damping import Damping
from hardware.interface import JointStops
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


def limits_of(settings: LimitSettings, robot: RobotModel, device_stops: JointStops) -> Limits:
    """Build the guard's limits; what the file leaves out is unlimited.

    Joints end where the device says, and where the file does or else the robot's description.
    """

    def vector(values: tuple[float, ...] | None, absent: float, length: int) -> FloatArray:
        return np.full(length, absent) if values is None else np.array(values)

    n, z = robot.joints, robot.task_dimension
    lower, upper = robot.position_limits_rad
    if settings.joint_min_rad is not None and settings.joint_max_rad is not None:
        lower, upper = np.array(settings.joint_min_rad), np.array(settings.joint_max_rad)
    return Limits(
        torque_nm=vector(settings.torque_nm, inf, n),
        torque_rate_nm_s=vector(settings.torque_rate_nm_s, inf, n),
        velocity_rad_s=vector(settings.velocity_rad_s, inf, n),
        kinetic_energy_j=inf if settings.kinetic_energy_j is None else settings.kinetic_energy_j,
        workspace_min_m=vector(settings.workspace_min_m, -inf, z),
        workspace_max_m=vector(settings.workspace_max_m, inf, z),
        stops=JointStops(
            np.concatenate((device_stops.matrix, np.eye(n))),
            np.concatenate((device_stops.lower_rad, lower)),
            np.concatenate((device_stops.upper_rad, upper)),
        ),
        fault_after_s=settings.fault_after_s,
    )
