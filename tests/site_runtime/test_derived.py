"""All rows at once, against the control law's own functions, one row at a time."""

from math import inf, nan
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from control_law.null_space import manipulability
from hardware.robot_model import PlanarArm, RobotModel, UrdfArm, build_robot
from site_runtime.derived import ArmRows, derivation, distance_rows, manipulability_rows
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import load_session
from telemetry.rows import DERIVED
from tests.control_law.chain_distance import midpoint_distance, segment_distance

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parents[2]
EXPERIMENTS = ROOT / "experiments"
ARMS = {
    "planar 2R": PlanarArm("planar", (0.38, 0.38), (0.3, 0.3)),
    "seven joints": UrdfArm("urdf", str(EXPERIMENTS / "seven_dof_arm.urdf"), "tool_tip"),
    "crooked": UrdfArm(
        "urdf", str(ROOT / "tests/hardware/crooked_arm.urdf"), "tool", task_dimension=2
    ),
}
MODELS = {name: build_robot(description, None) for name, description in ARMS.items()}
COORDINATE_M = st.floats(-1.5, 1.5)
TO_ROUNDING = {"rtol": 0.0, "atol": 1e-13}


@st.composite
def rows_of_an_arm(draw: st.DrawFn) -> tuple[RobotModel, FloatArray]:
    robot = MODELS[draw(st.sampled_from(sorted(MODELS)))]
    angle = st.floats(-7.0, 7.0) | st.just(0.0)
    row = st.lists(angle, min_size=robot.joints, max_size=robot.joints)
    return robot, np.array(draw(st.lists(row, min_size=1, max_size=3)))


@given(arm=rows_of_an_arm())
def test_every_row_has_the_pose_and_manipulability_that_the_tick_saw(
    arm: tuple[RobotModel, FloatArray],
) -> None:
    robot, q_rows = arm
    origins_m, axes = ArmRows(robot).pose(q_rows)
    index = manipulability_rows(origins_m, axes, robot.task_dimension)
    for row, q in enumerate(q_rows):
        terms = robot.terms(q, np.zeros(robot.joints))
        np.testing.assert_allclose(origins_m[..., row], terms.origins, **TO_ROUNDING)
        np.testing.assert_allclose(axes[..., row], terms.axes, **TO_ROUNDING)
        np.testing.assert_allclose(index[row], manipulability(terms.J), **TO_ROUNDING)


@given(
    points_m=st.lists(st.tuples(COORDINATE_M, COORDINATE_M, COORDINATE_M), min_size=2, max_size=5),
    centers_m=st.lists(st.tuples(COORDINATE_M, COORDINATE_M, COORDINATE_M), min_size=1, max_size=3),
    coincide=st.booleans(),
)
def test_every_row_has_the_distances_of_the_control_law(
    points_m: list[tuple[float, ...]], centers_m: list[tuple[float, ...]], coincide: bool
) -> None:
    one = np.array([points_m[0], *points_m] if coincide else points_m)
    chains = [one, one[::-1] - 0.1]
    links_m, midpoints_m = distance_rows(np.stack(chains, axis=2), np.array(centers_m))
    for found, measure in ((links_m, segment_distance), (midpoints_m, midpoint_distance)):
        expected = [min(measure(c, np.array(centre)) for centre in centers_m) for c in chains]
        np.testing.assert_allclose(found, expected, **TO_ROUNDING)


@pytest.mark.parametrize(
    ("center", "link", "midpoint"),
    [([0.5, 0.3], 0.3, 0.3), ([-0.3, 0.4], 0.5, np.hypot(0.8, 0.4)), ([1.2, 0.5], 0.2, 0.2),
     ([1.3, -0.4], 0.5, np.hypot(0.8, 0.4)), ([1.0, 0.0], 0.0, 0.5)],
)  # fmt: skip
def test_distances_in_known_places(center: list[float], link: float, midpoint: float) -> None:
    elbow = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    found = distance_rows(elbow[:, :, np.newaxis], np.array([[*center, 0.0]]))
    np.testing.assert_allclose(np.ravel(found), [link, midpoint], **TO_ROUNDING)


@given(
    arrays(np.float64, (4, 3), elements=st.floats(-1, 1)),
    arrays(np.float64, 3, elements=st.floats(-1, 1)),
)
def test_no_point_of_the_chain_is_nearer(origins: FloatArray, center: FloatArray) -> None:
    grid = np.linspace(0, 1, 101)[:, None, None]
    points = origins[:-1] + grid * np.diff(origins, axis=0)
    nearest = np.linalg.norm(points - center, axis=-1).min()
    link, midpoint = np.ravel(distance_rows(origins[:, :, np.newaxis], center[np.newaxis]))
    assert link <= nearest + 1e-12
    assert link >= nearest - 0.02  # half a grid step of the longest link
    assert link <= midpoint + 1e-12


@pytest.mark.parametrize("file", ["demo.toml", "seven_dof.toml"])
def test_a_session_s_rows_have_its_robots_and_obstacles(file: str) -> None:
    session = load_session(EXPERIMENTS / file)
    derive = derivation(session)
    obstacles_m = [np.array(obstacle.center_m) for obstacle in session.remote.obstacles]
    for site in SiteId:
        robot = robot_of(session, site)
        q_rows = np.random.default_rng(site).uniform(-2.0, 2.0, (20, robot.joints))
        derived = derive(site.label, q_rows)
        assert list(derived) == list(DERIVED)
        for row, q in enumerate(q_rows):
            terms = robot.terms(q, q)
            centres_m = obstacles_m if site is SiteId.REMOTE else []
            expected = (
                manipulability(terms.J),
                min((segment_distance(terms.origins, c) for c in centres_m), default=nan),
                min((midpoint_distance(terms.origins, c) for c in centres_m), default=nan),
            )
            found = [values[row] for values in derived.values()]
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("broken", [nan, inf])
def test_a_broken_reading_has_nothing_derived_and_spoils_no_other_row(broken: float) -> None:
    derive = derivation(load_session(EXPERIMENTS / "demo.toml"))
    q = np.full((3, 3), 0.5)
    q[1, 1] = broken
    whole = derive("remote", q[:1])
    for name, values in derive("remote", q).items():
        assert np.isnan(values[1]), name
        assert values[0] == values[2] == whole[name][0]


def test_no_rows_have_no_columns_of_any_length() -> None:
    derive = derivation(load_session(EXPERIMENTS / "demo.toml"))
    assert {len(values) for values in derive("remote", np.empty((0, 3))).values()} == {0}
