from pathlib import Path

import numpy as np
import pytest

from control_law.damping import Damping
from control_law.sampling import damping_ratio
from hardware.robot_model import PlanarArm, build_robot
from site_runtime.keys import SiteId
from site_runtime.parts import damping_of, robot_of
from site_runtime.pose_search import POSES, PoseSearch
from site_runtime.session import load_session

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def seven():
    session = load_session(EXPERIMENTS / "seven_dof.toml")
    return robot_of(session, SiteId.LOCAL), damping_of(session.local.damping)


def test_a_damper_at_a_point_mass_is_the_fastest_mode():
    """Nothing at the tip is lighter than the mass that sits there: λ = D/m, in any pose."""
    robot = build_robot(PlanarArm("planar", (0.38, 0.38, 0.38), (0.3, 0.3, 0.3)), None)
    mode = PoseSearch(robot, seed=1).fastest(Damping(np.full(3, 1e-9), np.full(2, 30.0)))
    assert mode.rate_per_s == pytest.approx(100.0, rel=1e-6)


def test_the_refined_pose_is_worse_than_every_random_one_and_within_the_limits(seven):
    robot, damping = seven
    mode = PoseSearch(robot, seed=1).fastest(damping)

    def rate(pose):
        terms = robot.terms(np.array(pose), np.zeros(robot.joints))
        return damping_ratio(1.0, terms.M, damping.matrix(terms.J))

    lower, upper = robot.position_limits_rad
    poses = np.random.default_rng(1).uniform(lower, upper, (POSES, robot.joints))
    assert mode.rate_per_s > 1.03 * max(map(rate, poses))
    assert mode.rate_per_s == pytest.approx(rate(mode.pose_rad))
    assert np.array_equal(np.clip(mode.pose_rad, lower, upper), mode.pose_rad)


def test_it_stays_within_narrow_limits():
    session = load_session(EXPERIMENTS / "seven_dof.toml")
    robot = robot_of(session, SiteId.LOCAL)
    middle = np.linspace(-0.8, 0.8, robot.joints)
    robot.position_limits_rad = (middle - 0.1, middle + 0.1)
    pose = PoseSearch(robot, seed=1).fastest(damping_of(session.local.damping)).pose_rad
    assert np.abs(pose - middle).max() == pytest.approx(0.1, abs=1e-9)


def test_it_is_in_proportion_to_the_damping_and_grows_with_either_kind(seven):
    robot, damping = seven
    search = PoseSearch(robot, seed=1)
    once = search.fastest(damping)
    twice = search.fastest(Damping(2.0 * damping.joint, 2.0 * damping.task))
    assert twice.rate_per_s == pytest.approx(2.0 * once.rate_per_s)
    for more in (
        Damping(damping.joint, 9.0 * damping.task),
        Damping(1.5 * damping.joint, damping.task),
    ):
        assert search.fastest(more).rate_per_s > 1.2 * once.rate_per_s


def test_the_joints_drag_at_the_end_effector(seven):
    robot, damping = seven
    search = PoseSearch(robot, seed=1)
    drags = []
    for pose in np.random.default_rng(8).uniform(*robot.position_limits_rad, (2000, robot.joints)):
        J = robot.terms(pose, np.zeros(robot.joints)).J
        drags.append(np.linalg.eigvalsh(np.linalg.inv(J / damping.joint @ J.T))[-1])
    assert search.joint_drag(damping.joint) == pytest.approx(np.median(drags), rel=0.05)
    assert search.joint_drag(3.0 * damping.joint) == pytest.approx(
        3.0 * search.joint_drag(damping.joint)
    )
