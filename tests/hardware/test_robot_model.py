"""The robot model against finite differences, hand formulas and the numbers the paper rests on."""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hardware.interface import DeviceConfigurationError, FloatArray
from hardware.robot_model import PlanarArm, RobotModel, UrdfArm, build_robot

HERE = Path(__file__).parent
SEVEN_DOF = HERE.parents[1] / "experiments" / "seven_dof_arm.urdf"
LINK_M, LINK_KG = 0.38, 0.3  # the paper's, Section VI


def paper_arm(joints: int, mass: str, gravity: tuple[float, float] = (0.0, 0.0)) -> RobotModel:
    return build_robot(
        PlanarArm("planar", (LINK_M,) * joints, (LINK_KG,) * joints, mass, gravity),  # type: ignore[arg-type]
        None,
    )


ROBOTS = {
    "planar 1R rod": paper_arm(1, "rod", (0.0, -9.81)),
    "planar 2R point": paper_arm(2, "point", (0.0, -9.81)),
    "planar 3R rod": paper_arm(3, "rod", (3.0, -9.0)),
    "planar 4R unequal": build_robot(
        PlanarArm("planar", (0.254, 0.1405, 0.21, 0.17), (1.0, 0.7, 0.2, 0.1), "rod"), None
    ),
    "seven joints": build_robot(UrdfArm("urdf", SEVEN_DOF.name, "tool_tip"), SEVEN_DOF.parent),
    "crooked": build_robot(UrdfArm("urdf", "crooked_arm.urdf", "tool"), HERE),
    "crooked, two axes": build_robot(
        UrdfArm("urdf", "crooked_arm.urdf", "tool", task_dimension=2), HERE
    ),
}

STEP = 1e-6  # of the finite differences


def assert_close(actual: npt.ArrayLike, expected: npt.ArrayLike, what: str = "") -> None:
    """Equal as far as finite differences can tell."""
    np.testing.assert_allclose(np.asarray(actual), np.asarray(expected), 1e-6, 2e-8, err_msg=what)


@st.composite
def motions(draw: st.DrawFn) -> tuple[RobotModel, FloatArray, FloatArray]:
    robot = ROBOTS[draw(st.sampled_from(sorted(ROBOTS)))]
    angles = arrays(np.float64, robot.joints, elements=st.floats(-math.pi, math.pi))
    rates = arrays(np.float64, robot.joints, elements=st.floats(-2.0, 2.0))
    return robot, draw(angles), draw(rates)


many = settings(max_examples=60, deadline=None)


def along_motion(robot: RobotModel, q: FloatArray, q_dot: FloatArray, name: str) -> FloatArray:
    """d/dt of one term as the arm moves on from q with q̇."""
    ahead = getattr(robot.terms(q + STEP * q_dot, q_dot), name)
    behind = getattr(robot.terms(q - STEP * q_dot, q_dot), name)
    return np.asarray((ahead - behind) / (2.0 * STEP))


@many
@given(motions())
def test_inertia_rate_minus_twice_coriolis_is_skew(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    N = along_motion(robot, q, q_dot, "M") - 2.0 * robot.terms(q, q_dot).C
    assert_close(N, -N.T)
    assert q_dot @ N @ q_dot == pytest.approx(0.0, abs=1e-7)


@many
@given(motions())
def test_inertia_is_symmetric_and_positive(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    M = robot.terms(q, q_dot).M
    np.testing.assert_array_equal(M, M.T)
    assert np.linalg.eigvalsh(M)[0] > 0.0
    np.testing.assert_allclose(robot.inverse_inertia(q) @ M, np.eye(robot.joints), atol=1e-9)


@many
@given(motions(), st.integers(0, 2**32 - 1))
def test_coriolis_is_symmetric_in_its_two_velocities(
    motion: tuple[RobotModel, FloatArray, FloatArray], seed: int
) -> None:
    robot, q, x = motion
    y = np.random.default_rng(seed).standard_normal(robot.joints)
    np.testing.assert_allclose(robot.terms(q, x).C @ y, robot.terms(q, y).C @ x, atol=1e-12)


@many
@given(motions())
def test_orientation_is_a_rotation_whose_rate_is_the_joints(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    R = robot.orientation(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    rate = (robot.orientation(q + STEP * q_dot) - robot.orientation(q - STEP * q_dot)) / (2 * STEP)
    spin = robot.terms(q, q_dot).axes.T @ q_dot  # of the last link, in base axes
    assert_close(rate, np.cross(spin, R, axisb=0, axisc=0))
    np.testing.assert_array_equal(robot.orientation(q), R)


def test_a_planar_arm_s_frame_has_x_along_the_last_link() -> None:
    robot, q = ROBOTS["planar 4R unequal"], np.array([0.3, -0.8, 1.1, 0.4])
    angle = q.sum()
    np.testing.assert_allclose(
        robot.orientation(q),
        [
            [math.cos(angle), -math.sin(angle), 0.0],
            [math.sin(angle), math.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ],
        atol=1e-15,
    )
    chain = robot.chain(q)
    np.testing.assert_allclose(chain[-1] - chain[-2], 0.17 * robot.orientation(q)[:, 0], atol=1e-12)


def test_a_urdf_s_frame_is_turned_as_the_file_says() -> None:
    path = HERE / "crooked_arm.urdf"
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    tool = data.oMf[model.getFrameId("tool", pin.FrameType.BODY)]
    robot = ROBOTS["crooked"]
    assert np.abs(tool.rotation - np.eye(3)).max() > 0.1
    np.testing.assert_allclose(robot.orientation(np.zeros(robot.joints)), tool.rotation, atol=1e-12)


@many
@given(motions())
def test_jacobian_is_the_derivative_of_position(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    terms = robot.terms(q, q_dot)
    for joint, direction in enumerate(np.eye(robot.joints)):
        column = along_motion(robot, q, direction, "X")
        assert_close(terms.J[:, joint], column)
    assert_close(terms.X_dot, along_motion(robot, q, q_dot, "X"))


@many
@given(motions())
def test_rates_are_the_derivatives_along_the_motion(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    terms = robot.terms(q, q_dot)
    for name in ("J", "origins", "axes"):
        rate = along_motion(robot, q, q_dot, name)
        assert_close(getattr(terms, f"{name}_dot"), rate, name)


@many
@given(motions())
def test_jacobian_columns_are_axis_cross_lever(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    terms = robot.terms(q, q_dot)
    z = robot.task_dimension
    columns = np.cross(terms.axes, terms.origins[-1] - terms.origins[:-1])
    np.testing.assert_allclose(terms.J, columns.T[:z], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(terms.axes, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(terms.X, terms.origins[-1, :z])


@many
@given(motions(), st.integers(0, 2**32 - 1))
def test_forward_dynamics_solves_the_equation_of_motion(
    motion: tuple[RobotModel, FloatArray, FloatArray], seed: int
) -> None:
    robot, q, q_dot = motion
    random = np.random.default_rng(seed)
    torque = random.standard_normal(robot.joints)
    force = random.standard_normal(robot.task_dimension)
    terms = robot.terms(q, q_dot)
    for applied, total in ((force, torque + terms.J.T @ force), (None, torque)):
        q_ddot = robot.forward_dynamics(q, q_dot, torque, applied)
        left = terms.M @ q_ddot + terms.C @ q_dot + terms.G
        np.testing.assert_allclose(left, total, rtol=1e-9, atol=1e-9)


@many
@given(motions())
def test_the_short_cuts_agree_with_the_full_terms(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, q_dot = motion
    terms = robot.terms(q, q_dot)
    X, X_dot, J = robot.end_effector(q, q_dot)
    for quick, full in ((X, terms.X), (X_dot, terms.X_dot), (J, terms.J)):
        np.testing.assert_allclose(quick, full, atol=1e-13)
    np.testing.assert_allclose(robot.chain(q), terms.origins, atol=1e-13)
    rows = robot.chain_rows(np.array([q, q_dot]))
    np.testing.assert_array_equal(rows[0], robot.chain(q))
    np.testing.assert_array_equal(rows[1], robot.chain(q_dot))


@many
@given(motions())
def test_no_pose_reaches_beyond_the_reach(
    motion: tuple[RobotModel, FloatArray, FloatArray],
) -> None:
    robot, q, _ = motion
    points = robot.chain(q)
    distances = np.linalg.norm(points[-1] - points[:-1], axis=1)
    assert (distances <= robot.reach_m * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_shapes(name: str) -> None:
    robot = ROBOTS[name]
    n, z = robot.joints, robot.task_dimension
    terms = robot.terms(np.full(n, 0.1), np.full(n, 0.2))
    shapes = {
        **dict.fromkeys(("q", "q_dot", "G"), (n,)),
        **dict.fromkeys(("X", "X_dot"), (z,)),
        **dict.fromkeys(("J", "J_dot"), (z, n)),
        **dict.fromkeys(("J_xyz", "J_xyz_dot"), (3, n)),
        **dict.fromkeys(("M", "C"), (n, n)),
        **dict.fromkeys(("origins", "origins_dot"), (n + 1, 3)),
        **dict.fromkeys(("axes", "axes_dot"), (n, 3)),
    }
    assert {field: getattr(terms, field).shape for field in shapes} == shapes
    assert robot.reach_m.shape == (n,)
    assert [limit.shape for limit in robot.position_limits_rad] == [(n,), (n,)]


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_terms_are_the_callers_to_keep(name: str) -> None:
    robot = ROBOTS[name]
    q, q_dot = np.full(robot.joints, 0.3), np.full(robot.joints, -0.7)
    kept, asked_later = robot.terms(q, q_dot), robot.terms(q, q_dot)
    names = [name for name in kept.__slots__ if not name.startswith("_")] + ["origins_dot"]
    before = {field: getattr(kept, field).copy() for field in names}
    q += 1.0
    q_dot += 1.0
    robot.terms(q, q_dot)
    robot.forward_dynamics(q, q_dot, q)
    for field, value in before.items():
        np.testing.assert_array_equal(getattr(kept, field), value, err_msg=field)
        np.testing.assert_array_equal(getattr(asked_later, field), value, err_msg=field)


def test_a_wrong_number_of_joints_is_refused() -> None:
    robot = ROBOTS["planar 2R point"]
    with pytest.raises(ValueError, match="size"):
        robot.terms(np.zeros(3), np.zeros(3))


# Planar arms: hand formulas and the numbers of the paper's robots.


@pytest.mark.parametrize("mass", ["point", "rod"])
@pytest.mark.parametrize("elbow_rad", [0.0, 0.4, math.pi / 2, -2.5])
def test_two_link_inertia_by_hand(mass: str, elbow_rad: float) -> None:
    # Link i: mass at the distance c_i from its joint, inertia I_i about its centre.
    if mass == "point":
        centre, inertia = LINK_M, 0.0
    else:
        centre, inertia = LINK_M / 2.0, LINK_KG * LINK_M**2 / 12.0
    m22 = inertia + LINK_KG * centre**2
    coupling = LINK_KG * LINK_M * centre * math.cos(elbow_rad)
    m11 = inertia + LINK_KG * centre**2 + LINK_KG * LINK_M**2 + m22 + 2.0 * coupling
    expected = [[m11, m22 + coupling], [m22 + coupling, m22]]
    M = paper_arm(2, mass).terms(np.array([0.7, elbow_rad]), np.zeros(2)).M
    np.testing.assert_allclose(M, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("joints", "mass", "expected"),
    [(2, "point", 0.0074), (3, "point", 0.0043), (2, "rod", 0.0029), (3, "rod", 0.0016)],
)
def test_smallest_inertia_of_the_papers_arms(joints: int, mass: str, expected: float) -> None:
    robot = paper_arm(joints, mass)
    angles = np.linspace(-math.pi, math.pi, 41)
    grid = np.stack(np.meshgrid(*[angles] * (joints - 1)), axis=-1).reshape(-1, joints - 1)
    still = np.zeros(joints)
    smallest = min(
        np.linalg.eigvalsh(robot.terms(np.array([0.0, *bends]), still).M)[0] for bends in grid
    )
    assert smallest == pytest.approx(expected, abs=6e-5)


@pytest.mark.parametrize(("joints", "expected"), [(2, 0.5776), (3, 1.2996)])
def test_largest_jacobian_product_is_the_reach_squared(joints: int, expected: float) -> None:
    robot = paper_arm(joints, "point")
    random = np.random.default_rng(0)
    still = np.zeros(joints)
    poses = [still, *random.uniform(-math.pi, math.pi, (300, joints))]
    largest = max(np.abs(J.T @ J).max() for J in (robot.terms(q, still).J for q in poses))
    assert largest == pytest.approx(expected, abs=1e-12)
    assert robot.reach_m[0] ** 2 == pytest.approx(expected, abs=1e-12)


def test_the_papers_initial_positions() -> None:
    local = paper_arm(2, "point").chain(np.array([2 * math.pi / 3, math.pi / 2]))[-1]
    remote = paper_arm(3, "point").chain(np.array([math.pi / 6, math.pi / 6, -math.pi / 6]))[-1]
    np.testing.assert_allclose(local, [-0.519, 0.139, 0.0], atol=5e-4)
    np.testing.assert_allclose(remote, [0.848, 0.709, 0.0], atol=5e-4)


@pytest.mark.parametrize(("mass", "share"), [("point", 1.0), ("rod", 0.5)])
def test_planar_gravity_is_the_gradient_of_potential_energy(mass: str, share: float) -> None:
    gravity = np.array([3.0, -9.0])
    robot = paper_arm(3, mass, (3.0, -9.0))

    def energy(q: FloatArray) -> float:
        points = robot.chain(q)[:, :2]
        centres = points[:-1] + share * np.diff(points, axis=0)
        return float(-LINK_KG * (centres @ gravity).sum())

    q = np.array([0.3, -1.1, 2.0])
    gradient = [
        (energy(q + STEP * axis) - energy(q - STEP * axis)) / (2 * STEP) for axis in np.eye(3)
    ]
    assert_close(robot.terms(q, np.zeros(3)).G, gradient)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lengths_m": ()}, "one length and one mass"),
        ({"masses_kg": (1.0,)}, "has 2, masses_kg has 1"),
        ({"lengths_m": (0.3, 0.0)}, r"lengths_m of link 2 is 0\.0"),
        ({"masses_kg": (-1.0, 1.0)}, r"masses_kg of link 1 is -1\.0"),
        ({"masses_kg": (math.nan, 1.0)}, "link 1 is nan"),
        ({"gravity_m_s2": (0.0, math.inf)}, "gravity_m_s2"),
    ],
)
def test_impossible_planar_arms_are_refused(change: dict[str, object], message: str) -> None:
    good = {"kind": "planar", "lengths_m": (0.3, 0.3), "masses_kg": (1.0, 1.0)}
    with pytest.raises(DeviceConfigurationError, match=message):
        PlanarArm(**(good | change))  # type: ignore[arg-type]


# URDF files.


def test_urdf_dynamics_match_pinocchio_on_the_whole_file() -> None:
    model = pin.buildModelFromUrdf(str(SEVEN_DOF))
    data = model.createData()
    random = np.random.default_rng(3)
    for _ in range(20):
        q, q_dot = random.uniform(-2.0, 2.0, (2, 7))
        terms = ROBOTS["seven joints"].terms(q, q_dot)
        np.testing.assert_allclose(terms.M, pin.crba(model, data, q), atol=1e-12)
        gradient = [
            (
                pin.computePotentialEnergy(model, data, q + STEP * axis)
                - pin.computePotentialEnergy(model, data, q - STEP * axis)
            )
            / (2.0 * STEP)
            for axis in np.eye(7)
        ]
        np.testing.assert_allclose(terms.G, gradient, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(
            terms.C @ q_dot + terms.G, pin.nonLinearEffects(model, data, q, q_dot), atol=1e-10
        )


def test_the_example_arm_is_a_workable_one() -> None:
    robot = ROBOTS["seven joints"]
    lower, upper = robot.position_limits_rad
    assert (lower < 0.0).all()
    assert (upper > 0.0).all()
    assert np.isfinite([lower, upper]).all()
    bent = np.array([0.0, 0.5, 0.0, 1.2, 0.0, 0.9, 0.0])
    J = robot.terms(bent, np.zeros(7)).J
    assert np.linalg.svd(J, compute_uv=False)[-1] > 0.1
    assert robot.reach_m[1] == pytest.approx(0.94)


def test_continuous_joints_have_no_limits_and_others_keep_theirs() -> None:
    lower, upper = ROBOTS["crooked"].position_limits_rad
    np.testing.assert_array_equal(lower, [-math.inf, -1.5, -math.inf, -2.5])
    np.testing.assert_array_equal(upper, [math.inf, 2.0, math.inf, 2.5])


def test_continuous_joints_match_pinocchio_and_the_gripper_stays_as_mass() -> None:
    model = pin.buildModelFromUrdf(str(HERE / "crooked_arm.urdf"))
    data = model.createData()
    q = np.array([2.5, 0.4, -1.9, 0.8])
    full = np.array(
        [math.cos(q[0]), math.sin(q[0]), q[1], math.cos(q[2]), math.sin(q[2]), q[3], 0, 0]
    )
    pin.framesForwardKinematics(model, data, full)
    terms = ROBOTS["crooked"].terms(q, np.zeros(4))
    tool = data.oMf[model.getFrameId("tool")].translation
    np.testing.assert_allclose(terms.X, tool, atol=1e-12)
    np.testing.assert_allclose(terms.M, pin.crba(model, data, full)[:4, :4], atol=1e-12)


def test_a_two_axis_task_is_the_first_two_rows() -> None:
    q, q_dot = np.full(4, 0.4), np.full(4, -0.3)
    two, three = (ROBOTS[name].terms(q, q_dot) for name in ("crooked, two axes", "crooked"))
    np.testing.assert_array_equal(two.J, three.J[:2])
    np.testing.assert_array_equal(two.X_dot, three.X_dot[:2])


def test_gravity_of_a_urdf_arm_is_the_descriptions() -> None:
    floating = build_robot(
        UrdfArm("urdf", "crooked_arm.urdf", "tool", gravity_m_s2=(0.0, 0.0, 0.0)), HERE
    )
    np.testing.assert_array_equal(floating.terms(np.ones(4), np.zeros(4)).G, np.zeros(4))
    assert np.abs(ROBOTS["crooked"].terms(np.ones(4), np.zeros(4)).G).max() > 0.1


def test_a_frame_up_the_arm_ends_the_chain_there() -> None:
    robot = build_robot(UrdfArm("urdf", "crooked_arm.urdf", "elbow"), HERE)
    assert robot.joints == 3
    # The link's frame is its joint's: the last link has no lever.
    assert robot.reach_m[-1] == pytest.approx(0.0, abs=1e-12)


def test_an_absolute_path_needs_no_base_directory() -> None:
    assert build_robot(UrdfArm("urdf", str(SEVEN_DOF), "tool_tip"), None).joints == 7


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ("tol", "no frame 'tol'; nearest: .*tool"),
        ("finger_a", "joint 'slide_a' .* is of type PY; only revolute and continuous"),
        ("pedestal", "does not move"),
    ],
)
def test_unusable_frames_are_explained(frame: str, message: str) -> None:
    with pytest.raises(DeviceConfigurationError, match=message):
        build_robot(UrdfArm("urdf", "crooked_arm.urdf", frame), HERE)


def edited(tmp_path: Path, old: str, new: str) -> UrdfArm:
    text = (HERE / "crooked_arm.urdf").read_text()
    assert old in text
    path = tmp_path / "edited.urdf"
    path.write_text(text.replace(old, new))
    return UrdfArm("urdf", str(path), "tool")


def test_a_prismatic_joint_on_the_chain_is_named(tmp_path: Path) -> None:
    arm = edited(tmp_path, '"shoulder" type="revolute"', '"shoulder" type="prismatic"')
    with pytest.raises(DeviceConfigurationError, match=r"joint 'shoulder' .* is of type P"):
        build_robot(arm, None)


def test_a_link_is_meant_where_a_joint_has_its_name(tmp_path: Path) -> None:
    assert build_robot(edited(tmp_path, '"bend" type', '"tool" type'), None).joints == 4


def test_a_coupled_joint_on_the_chain_is_named(tmp_path: Path) -> None:
    coupled = '<axis xyz="-1 0 0"/><mimic joint="shoulder" multiplier="2"/>'
    arm = edited(tmp_path, '<axis xyz="-1 0 0"/>', coupled)
    with pytest.raises(DeviceConfigurationError, match=r"joint 'twist' .* is of type Mimic"):
        build_robot(arm, None)


def test_links_without_mass_at_the_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "massless.urdf"
    path.write_text(
        '<robot name="massless"><link name="base"/><link name="tool"/>'
        '<joint name="only" type="continuous"><parent link="base"/><child link="tool"/>'
        '<axis xyz="0 0 1"/></joint></robot>'
    )
    with pytest.raises(DeviceConfigurationError, match="singular"):
        build_robot(UrdfArm("urdf", str(path), "tool"), None)


def test_missing_and_broken_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceConfigurationError, match=r"no URDF file .*nowhere\.urdf"):
        build_robot(UrdfArm("urdf", "nowhere.urdf", "tool"), tmp_path)
    (tmp_path / "broken.urdf").write_text("<robot")
    with pytest.raises(DeviceConfigurationError, match="cannot be read as URDF"):
        build_robot(UrdfArm("urdf", "/proc/self/mem", "tip"), None)
    with pytest.raises(DeviceConfigurationError, match="cannot be read as URDF"):
        build_robot(UrdfArm("urdf", "broken.urdf", "tool"), tmp_path)
    with pytest.raises(DeviceConfigurationError, match="gravity_m_s2"):
        UrdfArm("urdf", "any.urdf", "tool", gravity_m_s2=(0.0, math.nan, 0.0))
