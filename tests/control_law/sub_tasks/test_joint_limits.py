from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from control_law.sub_tasks.joint_limits import JointCentring

TASK = JointCentring(np.array([-1.0, -np.inf, 0.0]), np.array([3.0, np.inf, 0.5]), 0.2)


def test_is_the_gradient(
    planar_chain: Callable[..., Any], check_gradient: Callable[..., Any]
) -> None:
    q = np.array([0.4, -1.1, 0.4])
    g = check_gradient(
        TASK, planar_chain(3), q,
        lambda terms: 0.1 * (((terms.q[0] - 1) / 4) ** 2 + ((terms.q[2] - 0.25) / 0.5) ** 2),
    )  # fmt: skip
    assert g[0] > 0
    assert g[1] == 0
    assert g[2] < 0


def test_rate(
    planar_chain: Callable[..., Any],
    random_motion: Callable[..., Any],
    check_rate: Callable[..., Any],
) -> None:
    check_rate(TASK, planar_chain(3), random_motion(0, 3), 0.5)


def test_refuses_limits_out_of_order() -> None:
    with pytest.raises(ValueError, match="below"):
        JointCentring(np.zeros(2), np.array([1.0, 0.0]), 0.2)
