"""The control law fed by the robot model: the identities that its proof uses, on real arms."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from control_law.control import control_torque
from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.null_space import manipulability, null_space_velocity, project
from control_law.sub_tasks.composite import NormLimiter, WeightedSum
from control_law.sub_tasks.joint_limits import JointCentring
from control_law.sub_tasks.linear import LinearSingularityAvoidance
from control_law.sub_tasks.manipulability import ManipulabilityAscent
from control_law.sub_tasks.obstacle import SegmentAvoidance
from control_law.sub_tasks.paper_obstacle import StipanovicAvoidance
from control_law.sub_tasks.sub_task import SubTask
from hardware.robot_model import PlanarArm, RobotModel, UrdfArm, build_robot
from tests.control_law.chain_distance import midpoint_distance, segment_distance

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parents[2]
ARMS = {
    "planar 3R": PlanarArm("planar", (0.38, 0.38, 0.38), (0.3, 0.3, 0.3)),
    "planar 4R rods": PlanarArm(
        "planar", (0.3, 0.25, 0.2, 0.2), (0.5, 0.4, 0.3, 0.2), "rod", (0.0, -9.81)
    ),
    "seven joints": UrdfArm("urdf", str(ROOT / "experiments/seven_dof_arm.urdf"), "tool_tip"),
    "crooked": UrdfArm(
        "urdf", str(ROOT / "tests/hardware/crooked_arm.urdf"), "tool", task_dimension=2
    ),
}
STEP = 1e-5


@pytest.fixture(params=ARMS, scope="module")
def arm(request: pytest.FixtureRequest) -> RobotModel:
    return build_robot(ARMS[request.param], None)


@pytest.fixture(params=range(3))
def motion(request: pytest.FixtureRequest, arm: RobotModel) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(request.param)
    return rng.uniform(-1.5, 1.5, arm.joints), rng.uniform(-1.0, 1.0, arm.joints)


def sub_tasks(arm: RobotModel) -> dict[str, SubTask]:
    n = arm.joints
    centre = np.array([0.3, 0.2, 0.4])[: arm.task_dimension]
    parts: dict[str, SubTask] = {
        "linear": LinearSingularityAvoidance(0.3, np.linspace(-1.0, 1.0, n)),
        "manipulability": ManipulabilityAscent(3.0),
        "segments": SegmentAvoidance(centre, 0.9, 2.0),
        "midpoints": StipanovicAvoidance(centre, 0.9, 0.01, 0.05),
        "joint limits": JointCentring(np.full(n, -2.0), np.full(n, 3.0), 0.4),
    }
    parts["all, limited"] = NormLimiter(WeightedSum([*parts.values()], [1.0] * len(parts)), 0.8)
    return parts


TASKS = ["linear", "manipulability", "segments", "midpoints", "joint limits", "all, limited"]


@pytest.mark.parametrize("name", TASKS)
def test_a_sub_tasks_rate_is_that_of_its_value_along_the_motion(
    arm: RobotModel, motion: tuple[FloatArray, FloatArray], name: str
) -> None:
    q, q_dot = motion
    task = sub_tasks(arm)[name]
    g_dot = task.evaluate(arm.terms(q, q_dot))[1]
    ahead, behind = (task.evaluate(arm.terms(q + h * q_dot, q_dot))[0] for h in (STEP, -STEP))
    slope = (ahead - behind) / (2.0 * STEP)
    assert np.abs(g_dot - slope).max() <= 1e-5 * max(1.0, np.abs(slope).max())


def test_ascent_climbs_the_index(arm: RobotModel, motion: tuple[FloatArray, FloatArray]) -> None:
    q, rest = motion[0], np.zeros(arm.joints)
    g = ManipulabilityAscent(1.0).evaluate(arm.terms(q, rest))[0]
    slope = [
        (manipulability(arm.terms(q + h, rest).J) - manipulability(arm.terms(q - h, rest).J))
        / (2 * STEP)
        for h in STEP * np.eye(arm.joints)
    ]
    assert np.allclose(g, slope, atol=1e-8)
    J = arm.terms(q, rest).J
    assert manipulability(J) == pytest.approx(np.linalg.det(J @ J.T), rel=1e-9, abs=1e-15)


def test_avoidance_moves_away(arm: RobotModel, motion: tuple[FloatArray, FloatArray]) -> None:
    q, rest = motion[0], np.zeros(arm.joints)
    origins = arm.terms(q, rest).origins
    link = arm.joints - 1
    side = np.cross(origins[link + 1] - origins[link], [0.3, 0.5, 1.0])
    centre = 0.5 * (origins[link] + origins[link + 1]) + 0.02 * side / np.linalg.norm(side)
    segments, midpoints = (
        SegmentAvoidance(centre, 0.05, 1.0),
        StipanovicAvoidance(centre, 0.05, 0.01, 1.0),
    )
    for task, distance in ((segments, segment_distance), (midpoints, midpoint_distance)):
        g = task.evaluate(arm.terms(q, rest))[0]
        step = 1e-6 * g / np.linalg.norm(g)
        assert distance(arm.terms(q + step, rest).origins, centre) > distance(origins, centre)


@pytest.mark.parametrize("regularisation", [0.0, 1e-4])
def test_self_motion_is_invisible_and_its_rate_is_its_slope(
    arm: RobotModel, motion: tuple[FloatArray, FloatArray], regularisation: float
) -> None:
    q, q_dot = motion
    task = sub_tasks(arm)["all, limited"]

    def zeta_and_rate(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        terms = arm.terms(at, q_dot)
        g, g_dot = task.evaluate(terms)
        return null_space_velocity(terms.J, terms.J_dot, g, g_dot, regularisation)

    terms = arm.terms(q, q_dot)
    zeta, zeta_dot = zeta_and_rate(q)
    assert np.abs(terms.J @ zeta).max() < 1e-12
    assert np.allclose(terms.J @ zeta_dot, -terms.J_dot @ zeta, atol=1e-9)
    slope = (zeta_and_rate(q + STEP * q_dot)[0] - zeta_and_rate(q - STEP * q_dot)[0]) / (2 * STEP)
    assert np.allclose(zeta_dot, slope, rtol=1e-4, atol=1e-6)
    own = project(terms.J, zeta)
    assert np.allclose(own, zeta, atol=1e-9)


def test_the_closed_loop_is_the_papers_and_its_energy_falls_by_the_damping(
    arm: RobotModel, motion: tuple[FloatArray, FloatArray]
) -> None:
    q, q_dot = motion
    n, z = arm.joints, arm.task_dimension
    coupling = Coupling.from_stiffness(np.full(z, 80.0), np.full(z, 6.0))
    damping = Damping(np.linspace(0.1, 0.4, n), np.full(z, 9.0))
    task = sub_tasks(arm)["all, limited"]

    def zeta_at(at: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
        terms = arm.terms(at, rate)
        return null_space_velocity(terms.J, terms.J_dot, *task.evaluate(terms), 1e-4)

    terms = arm.terms(q, q_dot)
    zeta, zeta_dot = zeta_at(q, q_dot)
    force = coupling.force(np.linspace(-0.1, 0.2, z))
    torque, s = control_torque(terms, force, damping, zeta, zeta_dot)
    q_ddot = arm.forward_dynamics(q, q_dot, torque)
    s_dot = q_ddot - zeta_dot
    Lambda = damping.matrix(terms.J)
    residual = terms.M @ s_dot + terms.C @ s + Lambda @ s + terms.J.T @ force
    assert np.abs(residual).max() < 1e-8

    def kinetic(h: float) -> float:
        at, rate = q + h * q_dot + 0.5 * h * h * q_ddot, q_dot + h * q_ddot
        error = rate - zeta_at(at, rate)[0]
        return 0.5 * float(error @ arm.terms(at, rate).M @ error)

    power = (kinetic(STEP) - kinetic(-STEP)) / (2 * STEP)
    # d/dt ½sᵀMs = −sᵀΛs − Ẋᵀ ΩP(e): Ṁ − 2C is skew and J s = Ẋ
    expected = -s @ Lambda @ s - terms.X_dot @ force
    assert power == pytest.approx(expected, rel=1e-5, abs=1e-6)
