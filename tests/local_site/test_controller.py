import numpy as np
import pytest

from control_law.coupling import Coupling
from control_law.damping import Damping
from hardware.robot_model import PlanarArm, RobotModel, build_robot
from local_site.controller import LocalController

STIFFNESS, CEILING = np.array([200.0, 100.0]), np.array([15.0, 5.0])
JOINT, TASK = np.array([0.3, 0.1]), np.array([30.0, 20.0])


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    arm = PlanarArm("planar", (0.38, 0.3), (0.4, 0.3), gravity_m_s2=(0.0, -9.81))
    return build_robot(arm, None)


@pytest.fixture
def controller() -> LocalController:
    coupling = Coupling.from_stiffness(STIFFNESS, CEILING)
    return LocalController(coupling, Damping(JOINT, TASK))


def spring_n(error_m: np.ndarray) -> np.ndarray:
    """ΩP(e), written out."""
    width = 2.0 * CEILING / (np.pi * STIFFNESS)
    return STIFFNESS * width * np.arctan(error_m / width)


@pytest.mark.parametrize("seed", range(5))
def test_the_torque_is_gravity_minus_spring_minus_damping(
    robot: RobotModel, controller: LocalController, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    q, q_dot = rng.uniform(-2, 2, 2), rng.uniform(-3, 3, 2)
    terms, peer = robot.terms(q, q_dot), rng.uniform(-0.6, 0.6, 2)
    command = controller.step(terms, peer, force_share=1.0, engaged_s=10.0)
    force = spring_n(terms.X - peer)
    Lambda = np.diag(JOINT) + terms.J.T @ np.diag(TASK) @ terms.J
    expected = terms.G - terms.J.T @ force - Lambda @ q_dot
    assert np.allclose(command.torque_nm, expected, rtol=0, atol=1e-12)
    assert np.allclose(command.coupling_force_n, -force, rtol=0, atol=1e-12)
    assert command.sub_task_error_rad_s == 0.0


def test_the_spring_pulls_toward_the_peer(robot: RobotModel, controller: LocalController) -> None:
    terms = robot.terms(np.array([0.3, 1.2]), np.zeros(2))
    command = controller.step(
        terms, terms.X + np.array([0.01, -0.02]), force_share=1.0, engaged_s=10.0
    )
    assert command.coupling_force_n[0] > 0.0 > command.coupling_force_n[1]
    pushed = robot.forward_dynamics(terms.q, terms.q_dot, command.torque_nm)
    assert (terms.J @ pushed) @ command.coupling_force_n > 0.0


def test_at_the_peers_point_and_at_rest_only_gravity_is_carried(
    robot: RobotModel, controller: LocalController
) -> None:
    terms = robot.terms(np.array([0.3, 1.2]), np.zeros(2))
    assert np.array_equal(controller.step(terms, terms.X, 1.0, 5.0).torque_nm, terms.G)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_share_scales_the_spring_and_leaves_damping_and_gravity(
    robot: RobotModel, controller: LocalController, share: float
) -> None:
    terms = robot.terms(np.array([0.3, 1.2]), np.array([0.5, -0.4]))
    peer = terms.X + 0.3
    full = controller.step(terms, peer, 1.0, 100.0)
    command = controller.step(terms, peer, share, 0.1)
    assert np.allclose(command.coupling_force_n, share * full.coupling_force_n)
    rest = command.torque_nm - terms.J.T @ command.coupling_force_n
    assert np.allclose(rest, full.torque_nm - terms.J.T @ full.coupling_force_n)


def test_no_error_pulls_harder_than_the_ceiling(
    robot: RobotModel, controller: LocalController
) -> None:
    terms = robot.terms(np.array([0.3, 1.2]), np.zeros(2))
    for distance_m in (1.0, 100.0, 1e9):
        force = controller.step(terms, terms.X + distance_m, 1.0, 100.0).coupling_force_n
        assert (force < CEILING).all()
    assert force == pytest.approx(CEILING)
