"""The parallelogram and the serial arm are one robot; motion tells which third angle is given."""

import math

import numpy as np
import pytest

from hardware.phantom_kinematics import (
    NATIVE_LENGTHS_M,
    Parallelogram,
    ThirdAngle,
    ThirdAngleCheck,
)
from hardware.robot_model import PlanarArm, build_robot

L1, L2 = NATIVE_LENGTHS_M
ROBOT = build_robot(PlanarArm("planar", (L1, L2), (0.2, 0.2)), None)
RANDOM = np.random.default_rng(4)
POSES = RANDOM.uniform((-2.0, -0.5), (2.0, 3.5), (200, 2))  # θ2, absolute θ3


def given(theta: np.ndarray, third: ThirdAngle) -> tuple[float, float]:
    """What the device reports in a pose of absolute angles."""
    return float(theta[0]), float(theta[1] - (theta[0] if third == "relative" else 0.0))


def tip_m(theta: np.ndarray, l1: float = L1, l2: float = L2) -> np.ndarray:
    return np.array(
        [
            l1 * math.cos(theta[0]) + l2 * math.sin(theta[1]),
            l1 * math.sin(theta[0]) - l2 * math.cos(theta[1]),
        ]
    )


@pytest.mark.parametrize("third", ["absolute", "relative"])
def test_both_descriptions_put_the_tip_at_one_place(third: ThirdAngle) -> None:
    arm = Parallelogram((0.0, 0.0), third)
    for theta in POSES:
        q = arm.serial_rad(*given(theta, third))
        np.testing.assert_allclose(ROBOT.terms(q, np.zeros(2)).X, tip_m(theta), atol=1e-12)


def test_offsets_turn_the_links() -> None:
    theta = POSES[0]
    plain = Parallelogram((0.0, 0.0), "absolute").serial_rad(*theta)
    np.testing.assert_allclose(
        Parallelogram((0.3, -0.1), "absolute").serial_rad(*theta), plain + np.array([0.3, -0.1])
    )


@pytest.mark.parametrize("third", ["absolute", "relative"])
def test_torque_of_the_jacobian_pushes_with_one_force_and_power_in_both(third: ThirdAngle) -> None:
    arm = Parallelogram((0.2, -0.4), third)
    step = 1e-6
    for theta in POSES:
        v = np.array(given(theta, third))
        P = np.column_stack(
            [
                (arm.serial_rad(*(v + e)) - arm.serial_rad(*(v - e))) / (2 * step)
                for e in step * np.eye(2)
            ]
        )
        torque, rate = RANDOM.normal(size=2), RANDOM.normal(size=2)
        np.testing.assert_allclose(arm.device_nm(torque), P.T @ torque, atol=1e-8)
        power = torque @ (P @ rate)
        assert np.dot(arm.device_nm(torque), rate) == pytest.approx(power, abs=1e-8)
        # J_θ = J_q P: a force at the tip asks for the torques Jᵀ F in either description
        q = arm.serial_rad(*v)
        J_device = np.column_stack(
            [
                (
                    ROBOT.terms(arm.serial_rad(*(v + e)), np.zeros(2)).X
                    - ROBOT.terms(arm.serial_rad(*(v - e)), np.zeros(2)).X
                )
                / (2 * step)
                for e in step * np.eye(2)
            ]
        )
        force = RANDOM.normal(size=2)
        np.testing.assert_allclose(
            arm.device_nm(ROBOT.terms(q, np.zeros(2)).J.T @ force), J_device.T @ force, atol=1e-7
        )


# Poses of absolute angles [degrees] at one stop each, in the order of the rows.
AT_STOPS = [
    ("lower", 0, (-124.0, -100.0)),
    ("upper", 0, (119.0, 100.0)),
    ("lower", 1, (10.0, -29.0)),
    ("upper", 1, (100.0, 214.0)),
    ("lower", 2, (90.0, 25.0)),  # folded: θ2 − θ3 = 65°
    ("upper", 2, (-20.0, 35.0)),  # stretched: θ3 − θ2 = 55°
]


@pytest.mark.parametrize("third", ["absolute", "relative"])
@pytest.mark.parametrize(("side", "row", "degrees"), AT_STOPS)
def test_a_pose_at_a_stop_is_on_its_bound(
    side: str, row: int, degrees: tuple[float, float], third: ThirdAngle
) -> None:
    arm = Parallelogram((0.3, math.pi - 0.2), third)
    stops = arm.stops
    bound_rad = getattr(stops, f"{side}_rad")[row]

    def along(theta: np.ndarray) -> float:
        return float(stops.matrix[row] @ arm.serial_rad(*given(theta, third)))

    theta = np.radians(degrees)
    assert along(theta) == pytest.approx(bound_rad, abs=1e-12)
    outward = {0: (1.0, 0.0), 1: (0.0, 1.0), 2: (-1.0, 1.0)}[row]
    step = np.multiply(1e-3 if side == "upper" else -1e-3, outward)
    beyond = along(theta + step) - bound_rad
    assert (beyond > 0.0) == (side == "upper")


def test_the_folded_arm_s_stop_is_where_its_links_are_25_degrees_apart() -> None:
    links = []
    for bound in Parallelogram((0.0, 0.0), "absolute").stops.lower_rad[2:]:
        q = np.array([0.4, bound])
        tip, elbow = ROBOT.terms(q, np.zeros(2)).X, L1 * np.array([math.cos(0.4), math.sin(0.4)])
        links.append(math.acos(np.dot(-elbow, tip - elbow) / (L1 * L2)))
    assert np.degrees(links) == pytest.approx([25.0])


def feed(check: ThirdAngleCheck, path: np.ndarray, third: ThirdAngle, turret: float = 0.4) -> int:
    """Show a check the poses of a path as a device with slightly other link lengths would."""
    for count, theta in enumerate(path):
        r, height = tip_m(theta, 0.215, 0.170)
        position = (-1e3 * r * math.sin(turret), 1e3 * height + 77.0, -1e3 * r * math.cos(turret))
        check.add((turret, *given(theta, third)), position)
        if check.found is not None:
            return count
    return len(path)


@pytest.mark.parametrize("third", ["absolute", "relative"])
def test_motion_tells_the_third_angle(third: ThirdAngle) -> None:
    decided = 0
    for start in POSES:
        check = ThirdAngleCheck()
        way = RANDOM.uniform(-0.4, 0.4, 2)
        feed(check, start + np.linspace(0.0, 1.0, 200)[:, None] * way, third)
        assert check.found in (third, None)
        decided += check.found is not None
    assert decided > 0.8 * len(POSES)


def test_nothing_is_decided_at_rest_nor_by_a_tremble() -> None:
    check = ThirdAngleCheck()
    feed(check, np.array([0.3, 0.4]) + RANDOM.uniform(-0.005, 0.005, (500, 2)), "relative")
    assert check.found is None
    assert "move the arm" in check.open_question


def test_a_position_that_fits_neither_is_said_to() -> None:
    check = ThirdAngleCheck()
    for k in range(200):
        check.add((0.0, 0.01 * k, 0.005 * k), (0.0, 3.0 * k, -5.0 * k))
    assert check.found is None
    assert "neither" in check.open_question


def test_a_turning_turret_starts_the_comparison_anew() -> None:
    check = ThirdAngleCheck()
    path = np.array([0.3, 0.4]) + np.linspace(0.0, 0.05, 100)[:, None]
    for k, theta in enumerate(path):  # 0.03 rad a frame: 6 mm of the tip that are not the arm's
        feed(check, theta[None], "absolute", turret=0.03 * k)
    assert check.found is None
    feed(check, path, "absolute", turret=0.03 * 99)
    assert check.found == "absolute"


def test_a_jump_of_the_angles_is_forgotten_by_a_restart() -> None:
    check = ThirdAngleCheck()
    feed(check, POSES[:1], "absolute")
    check.restart()
    feed(check, POSES[1:2], "absolute")
    assert check.found is None
