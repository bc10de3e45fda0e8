"""The remote law against its own closed loop, Mṡ + Cs + Λs + JᵀΩP(e) = 0, on the robot model."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from control_law.coupling import Coupling
from control_law.damping import Damping
from control_law.ramp import smooth_ramp
from control_law.sub_tasks.linear import LinearSingularityAvoidance
from control_law.sub_tasks.manipulability import ManipulabilityAscent
from control_law.sub_tasks.obstacle import SegmentAvoidance
from control_law.sub_tasks.sub_task import SubTask
from hardware.robot_model import PlanarArm, RobotModel, RobotTerms, build_robot
from remote_site.controller import RemoteController

FloatArray = npt.NDArray[np.float64]
STIFFNESS, CEILING = np.array([200.0, 100.0]), np.array([15.0, 5.0])
JOINT, TASK = np.array([0.3, 0.1, 0.2]), np.array([30.0, 20.0])
SUB_TASKS: dict[str, SubTask] = {
    "linear": LinearSingularityAvoidance(0.5, np.array([1.0, -2.0, 1.0])),
    "manipulability": ManipulabilityAscent(20.0),
    "obstacle": SegmentAvoidance(np.array([0.2, 0.2]), 0.5, 20.0),
}
LONG_S = 100.0


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    arm = PlanarArm("planar", (0.38, 0.3, 0.25), (0.4, 0.3, 0.2), "rod", (0.0, -9.81))
    return build_robot(arm, None)


def controller_of(sub_task: SubTask | None, regularisation: float = 1e-4) -> RemoteController:
    return RemoteController(
        coupling=Coupling.from_stiffness(STIFFNESS, CEILING),
        damping=Damping(JOINT, TASK),
        sub_task=sub_task,
        sub_task_ramp_s=0.5,
        regularisation=regularisation,
    )


def spring_n(error_m: FloatArray) -> FloatArray:
    width = 2.0 * CEILING / (np.pi * STIFFNESS)
    return STIFFNESS * width * np.arctan(error_m / width)


def damping_matrix(J: FloatArray) -> FloatArray:
    return np.diag(JOINT) + J.T @ np.diag(TASK) @ J


def null_space(J: FloatArray) -> FloatArray:
    return np.eye(J.shape[1]) - np.linalg.pinv(J) @ J


def zeta_of(
    terms: RobotTerms, sub_task: SubTask, regularisation: float, share: float
) -> FloatArray:
    """ζ of (4) by the pseudo-inverse, times w/(w+ε)."""
    w = np.linalg.det(terms.J @ terms.J.T)
    g = share * sub_task.evaluate(terms)[0]
    return w / (w + regularisation) * null_space(terms.J) @ g


def pose(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.3, 1.2, 3), rng.uniform(-2, 2, 3), rng.uniform(-0.6, 0.6, 2)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("engaged_s", [0.2, LONG_S])
@pytest.mark.parametrize("name", SUB_TASKS)
def test_the_closed_loop_is_that_of_the_paper(
    robot: RobotModel, name: str, engaged_s: float, seed: int
) -> None:
    sub_task, regularisation, share = SUB_TASKS[name], 1e-4, 0.3
    q, q_dot, peer = pose(seed)
    terms = robot.terms(q, q_dot)
    command = controller_of(sub_task).step(terms, peer, share, engaged_s)
    q_ddot = robot.forward_dynamics(q, q_dot, command.torque_nm)

    def zeta(h: float) -> FloatArray:
        ahead = robot.terms(q + h * q_dot + 0.5 * h * h * q_ddot, q_dot + h * q_ddot)
        ramp, _ = smooth_ramp(engaged_s + h, 0.5)
        return zeta_of(ahead, sub_task, regularisation, ramp)

    h = 1e-5
    s, s_dot = q_dot - zeta(0.0), q_ddot - (zeta(h) - zeta(-h)) / (2 * h)
    force = share * spring_n(terms.X - peer)
    residual = terms.M @ s_dot + terms.C @ s + damping_matrix(terms.J) @ s + terms.J.T @ force
    scale = np.abs(damping_matrix(terms.J) @ s).max()
    assert np.abs(residual).max() < 1e-6 * max(1.0, scale)
    assert command.coupling_force_n == pytest.approx(-force)


@pytest.mark.parametrize("seed", range(3))
def test_without_a_sub_task_it_is_the_local_law(robot: RobotModel, seed: int) -> None:
    q, q_dot, peer = pose(seed)
    terms = robot.terms(q, q_dot)
    command = controller_of(None).step(terms, peer, 1.0, LONG_S)
    expected = terms.G - terms.J.T @ spring_n(terms.X - peer) - damping_matrix(terms.J) @ q_dot
    assert command.torque_nm == pytest.approx(expected, abs=1e-12)
    assert command.sub_task_error_rad_s == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_the_sub_task_does_not_move_the_end_effector(robot: RobotModel, seed: int) -> None:
    """ζ, and so what it adds to the closed loop's acceleration at s = 0, is invisible in X."""
    q = pose(seed)[0]
    sub_task = SUB_TASKS["manipulability"]
    zeta = zeta_of(robot.terms(q, np.zeros(3)), sub_task, 1e-4, 1.0)
    terms = robot.terms(q, zeta)
    assert np.abs(terms.X_dot).max() < 1e-12
    assert np.linalg.norm(zeta) > 0.01
    at_rest = replace(controller_of(sub_task), damping=Damping(JOINT, np.zeros(2)))
    command = at_rest.step(terms, terms.X, 1.0, LONG_S)  # s = 0, e = 0
    q_ddot = robot.forward_dynamics(q, zeta, command.torque_nm)
    assert np.abs(terms.J @ q_ddot + terms.J_dot @ zeta).max() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_the_sub_task_error_is_the_self_motion_not_yet_as_wished(
    robot: RobotModel, seed: int
) -> None:
    q, q_dot, peer = pose(seed)
    sub_task = SUB_TASKS["manipulability"]
    terms = robot.terms(q, q_dot)
    command = controller_of(sub_task, regularisation=0.0).step(terms, peer, 1.0, LONG_S)
    error = null_space(terms.J) @ (q_dot - sub_task.evaluate(terms)[0])  # (21)
    assert command.sub_task_error_rad_s == pytest.approx(np.linalg.norm(error), rel=1e-9)


def test_the_sub_task_is_absent_at_engagement_and_ramped_in(robot: RobotModel) -> None:
    q, q_dot, peer = pose(0)
    terms = robot.terms(q, q_dot)
    with_task = controller_of(SUB_TASKS["obstacle"]).step(terms, peer, 0.5, 0.0)
    without = controller_of(None).step(terms, peer, 0.5, 0.0)
    assert with_task.torque_nm == pytest.approx(without.torque_nm, abs=1e-12)
    later = controller_of(SUB_TASKS["obstacle"]).step(terms, peer, 0.5, 0.25)
    assert not np.allclose(
        later.torque_nm, controller_of(None).step(terms, peer, 0.5, 0.25).torque_nm
    )


def test_a_singular_pose_is_passed_through(robot: RobotModel) -> None:
    terms = robot.terms(np.array([0.4, 0.0, 0.0]), np.array([0.1, 0.2, 0.3]))
    command = controller_of(SUB_TASKS["manipulability"]).step(terms, np.zeros(2), 1.0, LONG_S)
    assert np.isfinite(command.torque_nm).all()
    assert command.sub_task_error_rad_s == pytest.approx(0.0, abs=1e-9)
