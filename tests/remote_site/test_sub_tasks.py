from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest

from control_law.sub_tasks.composite import NormLimiter, WeightedSum
from control_law.sub_tasks.joint_limits import JointCentring
from control_law.sub_tasks.linear import LinearSingularityAvoidance
from control_law.sub_tasks.manipulability import ManipulabilityAscent
from control_law.sub_tasks.obstacle import SegmentAvoidance
from control_law.sub_tasks.paper_obstacle import StipanovicAvoidance
from hardware.robot_model import RobotModel, UrdfArm, build_robot
from remote_site.sub_tasks import build_sub_task
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import (
    JointLimitsTask,
    LinearSingularityTask,
    ManipulabilityTask,
    NullSpaceSettings,
    ObstacleSettings,
    ObstacleTask,
    PaperObstacleTask,
    RemoteSettings,
    SubTaskSettings,
    load_session,
)

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
POSTS = (
    ObstacleSettings("near", (0.2, 0.2), 0.07, 0.18),
    ObstacleSettings("far", (0.4, 0.0), 0.05, 0.3),
)


@pytest.fixture(scope="module")
def base() -> RemoteSettings:
    return load_session(EXPERIMENTS / "paper_free.toml").remote


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return robot_of(load_session(EXPERIMENTS / "paper_free.toml"), SiteId.REMOTE)


def settings(
    base: RemoteSettings,
    *tasks: SubTaskSettings,
    obstacles: Sequence[ObstacleSettings] = POSTS,
    rate_limit_rad_s: float = inf,
) -> RemoteSettings:
    return replace(
        base,
        sub_tasks=tasks,
        obstacles=tuple(obstacles),
        null_space=NullSpaceSettings(rate_limit_rad_s=rate_limit_rad_s),
    )


def test_without_sub_tasks_there_is_none(base: RemoteSettings, robot: RobotModel) -> None:
    assert build_sub_task(settings(base), robot) is None


def test_every_kind_is_built_obstacles_once_an_obstacle(
    base: RemoteSettings, robot: RobotModel
) -> None:
    built = build_sub_task(
        settings(
            base,
            LinearSingularityTask("linear_singularity", 0.01, (1.0, -2.0, 1.0), weight=2.0),
            ManipulabilityTask("manipulability", 4.0),
            ObstacleTask("obstacle", 400.0, weight=3.0),
            PaperObstacleTask("paper_obstacle", 1.0, weight=0.5),
            JointLimitsTask("joint_limits", 0.2, (-1.0, -1.0, -1.0), (1.0, 2.0, 3.0)),
        ),
        robot,
    )
    assert isinstance(built, WeightedSum)
    assert [type(task) for task in built.tasks] == [
        LinearSingularityAvoidance,
        ManipulabilityAscent,
        SegmentAvoidance,
        SegmentAvoidance,
        StipanovicAvoidance,
        StipanovicAvoidance,
        JointCentring,
    ]
    assert list(built.weights) == [2.0, 1.0, 3.0, 3.0, 0.5, 0.5, 1.0]
    linear, ascent, near, far, paper, _, centring = built.tasks
    assert linear.gain == 0.01
    assert linear.direction.tolist() == [1.0, -2.0, 1.0]
    assert ascent.gain == 4.0
    assert (near.activation_distance_m, far.activation_distance_m) == (0.18, 0.3)
    assert (near.gain, near.center.tolist(), far.center.tolist()) == (400.0, [0.2, 0.2], [0.4, 0.0])
    assert (paper.safe_radius_m, paper.collision_radius_m, paper.gain) == (0.18, 0.07, 1.0)
    assert centring.upper_rad.tolist() == [1.0, 2.0, 3.0]


def test_the_sum_is_weighted(base: RemoteSettings, robot: RobotModel) -> None:
    terms = robot.terms(np.array([0.4, 0.9, -0.3]), np.array([0.1, 0.2, -0.3]))
    linear = LinearSingularityTask("linear_singularity", 0.01, (1.0, -2.0, 1.0), weight=2.0)
    ascent = ManipulabilityTask("manipulability", 4.0, weight=0.5)
    both = build_sub_task(settings(base, linear, ascent), robot)
    assert both is not None
    a = np.array([1.0, -2.0, 1.0])
    g, g_dot = both.evaluate(terms)
    climb, climb_dot = ManipulabilityAscent(4.0).evaluate(terms)
    assert np.allclose(g, 2.0 * -0.01 * (a @ terms.q) * a + 0.5 * climb)
    assert np.allclose(g_dot, 2.0 * -0.01 * (a @ terms.q_dot) * a + 0.5 * climb_dot)


def test_a_rate_limit_bounds_the_norm_and_keeps_the_direction(
    base: RemoteSettings, robot: RobotModel
) -> None:
    terms = robot.terms(np.array([0.4, 0.9, -0.3]), np.zeros(3))
    task = ManipulabilityTask("manipulability", 1e6)
    limited = build_sub_task(settings(base, task, rate_limit_rad_s=0.7), robot)
    free = build_sub_task(settings(base, task), robot)
    assert isinstance(limited, NormLimiter)
    assert free is not None
    g, unlimited = limited.evaluate(terms)[0], free.evaluate(terms)[0]
    assert np.linalg.norm(g) == pytest.approx(0.7, rel=1e-6)
    assert np.allclose(g / 0.7, unlimited / np.linalg.norm(unlimited), atol=1e-6)


def test_joint_limits_are_the_urdfs_unless_the_file_gives_them(base: RemoteSettings) -> None:
    arm = build_robot(UrdfArm("urdf", "seven_dof_arm.urdf", "tool_tip"), EXPERIMENTS)
    centring = build_sub_task(settings(base, JointLimitsTask("joint_limits", 0.2)), arm)
    assert isinstance(centring, JointCentring)
    lower, upper = arm.position_limits_rad
    assert np.array_equal(centring.lower_rad, lower)
    assert np.array_equal(centring.upper_rad, upper)
