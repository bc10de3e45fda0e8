import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from control_law.sub_tasks.obstacle_distance import midpoint_distance, segment_distance

FloatArray = npt.NDArray[np.float64]


ELBOW = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])


@pytest.mark.parametrize(
    ("center", "segment", "midpoint"),
    [([0.5, 0.3], 0.3, 0.3), ([-0.3, 0.4], 0.5, np.hypot(0.8, 0.4)), ([1.2, 0.5], 0.2, 0.2),
     ([1.3, -0.4], 0.5, np.hypot(0.8, 0.4)), ([1.0, 0.0], 0.0, 0.5)],
)  # fmt: skip
def test_known_places(center: list[float], segment: float, midpoint: float) -> None:
    assert segment_distance(ELBOW, np.array(center)) == pytest.approx(segment)
    assert midpoint_distance(ELBOW, np.array(center)) == pytest.approx(midpoint)


@given(
    arrays(np.float64, (4, 3), elements=st.floats(-1, 1)),
    arrays(np.float64, 3, elements=st.floats(-1, 1)),
)
def test_no_point_of_the_chain_is_nearer(origins: FloatArray, center: FloatArray) -> None:
    grid = np.linspace(0, 1, 101)[:, None, None]
    points = origins[:-1] + grid * np.diff(origins, axis=0)
    nearest = np.linalg.norm(points - center, axis=-1).min()
    distance = segment_distance(origins, center)
    assert distance <= nearest + 1e-12
    assert distance >= nearest - 0.02  # half a grid step of the longest link
    assert distance <= midpoint_distance(origins, center) + 1e-12
