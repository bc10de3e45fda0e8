import numpy as np
import pytest

from control_law.damping import Damping


@pytest.mark.parametrize("task", [[0.0, 0.0], [10.0, 5.0]])
def test_apply_is_the_matrix_times_s(task: list[float]) -> None:
    rng = np.random.default_rng(0)
    J, s = rng.normal(size=(2, 3)), rng.normal(size=3)
    damping = Damping(np.array([1.0, 2.0, 3.0]), np.array(task))
    explicit = np.diag([1.0, 2.0, 3.0]) + J.T @ np.diag(task) @ J
    np.testing.assert_allclose(damping.matrix(J), explicit)
    np.testing.assert_allclose(damping.apply(J, s), explicit @ s)


@pytest.mark.parametrize("joint", [[1.0, 0.0], [1.0, -1.0], [1.0, np.nan]])
def test_refuses_an_undamped_joint(joint: list[float]) -> None:
    with pytest.raises(ValueError, match="joint damping"):
        Damping(np.array(joint), np.zeros(2))


def test_refuses_negative_task_damping() -> None:
    with pytest.raises(ValueError, match="task damping"):
        Damping(np.ones(2), np.array([1.0, -1e-9]))
