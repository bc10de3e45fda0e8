from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from telemetry.picture import (
    Extent,
    ObstacleView,
    Picture,
    Scene,
    SiteView,
    WallView,
    wall_lines,
)
from telemetry.rows import TelemetryError

FloatArray = npt.NDArray[np.float64]
Chain = Callable[[FloatArray], FloatArray]

SCENE = Scene((ObstacleView("o", (0.2, -0.3, 0.0), 0.05, 0.1),))


def picture_of(chain: Chain, dimensions: tuple[int, int] = (2, 2)) -> Picture:
    sites = (
        SiteView("local", (1, 2, 3), chain, 2, dimensions[0]),
        SiteView("remote", (4, 5, 6), chain, 3, dimensions[1]),
    )
    return Picture(sites, SCENE, {}, full_scale_force_n=10.0)


def test_the_shorter_arm_sets_the_scale(chain: Chain) -> None:
    assert picture_of(chain).reach_m == pytest.approx(2 * 0.38)


def test_one_picture_has_one_task_space(chain: Chain) -> None:
    with pytest.raises(TelemetryError, match="one task space"):
        picture_of(chain, (2, 3))


def test_arrows_grow_with_the_force_up_to_the_arms_length(chain: Chain) -> None:
    picture = picture_of(chain)
    forces_n = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, -5.0], [3e3, 4e3]])
    expected = [[0.0, 0.0], [0.38, 0.0], [0.0, -0.19], [0.6 * 0.76, 0.8 * 0.76]]
    assert picture.arrows(forces_n) == pytest.approx(np.array(expected))


def test_the_extent_holds_obstacles_and_grows_only_when_left(chain: Chain) -> None:
    extent = Extent(picture_of(chain))
    assert extent.low[1] <= -0.4
    inside = (extent.low + extent.high) / 2
    assert not extent.include(inside[None])
    point = extent.high + np.array([0.1, 0.0, 0.0])
    assert extent.include(point[None])
    assert extent.high[0] > point[0]
    assert not extent.include(np.stack((inside, point)))


@pytest.mark.parametrize("spatial", [False, True])
def test_walls_are_drawn_in_their_plane_and_hatched_behind_it(spatial: bool) -> None:
    normal = np.array([-3.0, 4.0, 0.0])
    wall = WallView((0.5, 0.1, 0.0), (-3.0, 4.0, 0.0))
    lines = np.concatenate(wall_lines(wall, 1.0, spatial=spatial))
    axes = lines.shape[1]
    assert axes == (3 if spatial else 2)
    heights = (lines - np.array(wall.point_m)[:axes]) @ normal[:axes] / 5.0
    assert heights.max() == pytest.approx(0.0, abs=1e-12)
    assert heights.min() == pytest.approx(0.0 if spatial else -1 / 25)
