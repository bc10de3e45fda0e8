import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from remote_site.environments import Wall, Walls, build_environment
from site_runtime.session import EnvironmentSettings, WallSettings

REST = np.zeros(2)
FACING_LEFT = WallSettings("wall", (0.48, 0.0), (-2.0, 0.0), 2000.0, 10.0)
FLOOR = WallSettings("floor", (0.0, 0.1), (0.0, 1.0), 1000.0)
coordinates = st.tuples(st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


def test_free_space_pushes_nowhere() -> None:
    assert build_environment(EnvironmentSettings(), 3) is None


def test_a_wall_pushes_along_its_normal_by_the_depth_whatever_the_normals_length() -> None:
    walls = build_environment(EnvironmentSettings((FACING_LEFT,)), 2)
    assert walls.force_n(0.0, np.array([0.49, 0.7]), REST) == pytest.approx([-20.0, 0.0])
    assert not walls.force_n(0.0, np.array([0.48, 0.7]), REST).any()
    assert not walls.force_n(0.0, np.array([0.40, 0.7]), REST).any()


def test_it_resists_going_in_and_lets_go_without_pulling() -> None:
    wall = Wall.of(FACING_LEFT)
    inside = np.array([0.49, 0.0])
    assert wall.push_n(inside, np.array([1.0, 5.0])) == pytest.approx(20.0 + 10.0)
    assert wall.push_n(inside, np.array([-1.0, 0.0])) == pytest.approx(20.0 - 10.0)
    assert wall.push_n(inside, np.array([-3.0, 0.0])) == 0.0
    assert wall.push_n(np.array([0.47, 0.0]), np.array([9.0, 0.0])) == 0.0


def test_in_a_corner_both_walls_push() -> None:
    walls = build_environment(EnvironmentSettings((FACING_LEFT, FLOOR)), 2)
    assert walls.force_n(0.0, np.array([0.485, 0.09]), REST) == pytest.approx([-10.0, 10.0])


@given(position=coordinates, velocity=coordinates)
def test_a_wall_never_pulls(position: np.ndarray, velocity: np.ndarray) -> None:
    walls = build_environment(EnvironmentSettings((FACING_LEFT, FLOOR)), 2)
    force = walls.force_n(0.0, position, 10.0 * velocity)
    assert force[0] <= 0.0 <= force[1]


@given(start=st.floats(0.0, 0.02), amplitude=st.floats(0.01, 0.1), rate_rad_s=st.floats(1.0, 50.0))
def test_no_touch_brings_more_energy_back_than_went_in(
    start: float, amplitude: float, rate_rad_s: float
) -> None:
    wall = Walls((Wall.of(FACING_LEFT),), 2)
    time_s = np.linspace(0.0, 2 * np.pi / rate_rad_s, 1001)
    x = 0.48 - start + amplitude * np.sin(rate_rad_s * time_s)
    v = amplitude * rate_rad_s * np.cos(rate_rad_s * time_s)
    work = np.array(
        [
            wall.force_n(0.0, np.array([xi, 0.0]), np.array([vi, 0.0]))[0] * vi
            for xi, vi in zip(x, v, strict=True)
        ]
    )
    spring_j = 0.5 * 2000.0 * amplitude**2
    assert np.trapezoid(work, time_s) <= 1e-3 * spring_j
