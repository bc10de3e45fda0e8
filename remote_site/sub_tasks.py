"""The remote robot's sub-tasks, from the session file."""

from math import isinf

import numpy as np

from control_law.sub_tasks.composite import NormLimiter, WeightedSum
from control_law.sub_tasks.joint_limits import JointCentring
from control_law.sub_tasks.linear import LinearSingularityAvoidance
from control_law.sub_tasks.manipulability import ManipulabilityAscent
from control_law.sub_tasks.obstacle import SegmentAvoidance
from control_law.sub_tasks.paper_obstacle import StipanovicAvoidance
from control_law.sub_tasks.sub_task import SubTask
from hardware.robot_model import RobotModel
from site_runtime.session import (
    JointLimitsTask,
    LinearSingularityTask,
    ManipulabilityTask,
    ObstacleTask,
    PaperObstacleTask,
    RemoteSettings,
    SubTaskSettings,
)


def build_sub_task(settings: RemoteSettings, robot: RobotModel) -> SubTask | None:
    """Build the weighted sum of all sub-tasks, its norm limited; None without any."""
    tasks: list[SubTask] = []
    weights: list[float] = []
    for task in settings.sub_tasks:
        built = _build(task, settings, robot)
        tasks += built
        weights += [task.weight] * len(built)
    if not tasks:
        return None
    total = tasks[0] if weights == [1.0] else WeightedSum(tasks, weights)
    limit = settings.null_space.rate_limit_rad_s
    return total if isinf(limit) else NormLimiter(total, limit)


def _build(task: SubTaskSettings, settings: RemoteSettings, robot: RobotModel) -> list[SubTask]:
    """One sub-task; for obstacles, one an obstacle."""
    match task:
        case LinearSingularityTask():
            return [LinearSingularityAvoidance(task.gain, np.array(task.direction))]
        case ManipulabilityTask():
            return [ManipulabilityAscent(task.gain)]
        case JointLimitsTask():
            lower, upper = robot.position_limits_rad
            if task.lower_rad is not None and task.upper_rad is not None:
                lower, upper = np.array(task.lower_rad), np.array(task.upper_rad)
            return [JointCentring(lower, upper, task.gain)]
        case ObstacleTask():
            return [
                SegmentAvoidance(np.array(item.center_m), item.safe_radius_m, task.gain)
                for item in settings.obstacles
            ]
        case PaperObstacleTask():
            return [
                StipanovicAvoidance(
                    np.array(item.center_m), item.safe_radius_m, item.collision_radius_m, task.gain
                )
                for item in settings.obstacles
            ]
