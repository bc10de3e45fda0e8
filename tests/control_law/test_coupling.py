from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from control_law.coupling import Coupling
from control_law.saturation import Arctangent


def test_stiffness_and_ceiling_are_what_was_asked_for() -> None:
    stiffness, ceiling = np.array([50.0, 200.0]), np.array([5.0, 8.0])
    coupling = Coupling.from_stiffness(stiffness, ceiling)
    np.testing.assert_allclose(coupling.stiffness, stiffness)
    np.testing.assert_allclose(coupling.force_ceiling, ceiling)
    np.testing.assert_allclose(coupling.force(np.array([1e-6, -1e-6])), [5e-5, -2e-4], rtol=1e-6)
    np.testing.assert_allclose(coupling.force(np.array([1e6, -1e6])), [5.0, -8.0], rtol=1e-6)


def test_five_newtons_at_fifty_newtons_a_metre_bend_at_64_mm() -> None:
    coupling = Coupling.from_stiffness(np.array([50.0]), np.array([5.0]))
    np.testing.assert_allclose(coupling.saturation.width, 0.0637, atol=5e-5)


def test_the_papers_coupling() -> None:
    coupling = Coupling.paper(np.array([1.0, 2.0]), np.array([1.0, 0.5]))
    np.testing.assert_allclose(coupling.force(np.array([1.0, 1.0])), [np.pi / 4, np.pi / 4])
    np.testing.assert_allclose(coupling.stiffness, [1.0, 1.0])
    np.testing.assert_allclose(coupling.force_ceiling, [np.pi / 2, np.pi / 2])


def test_energy_is_the_work_against_the_force(gradient: Callable[..., Any]) -> None:
    coupling = Coupling.from_stiffness(np.array([50.0, 20.0]), np.array([5.0, 1.0]))
    error = np.array([0.13, -0.4])
    np.testing.assert_allclose(gradient(coupling.energy, error), coupling.force(error), rtol=1e-7)
    assert coupling.energy(np.zeros(2)) == 0.0


@pytest.mark.parametrize("omega", [[1.0], [1.0, 0.0], [1.0, np.inf]])
def test_refuses_an_omega_that_is_not_positive_per_axis(omega: list[float]) -> None:
    with pytest.raises(ValueError, match="omega"):
        Coupling(np.array(omega), Arctangent.paper(np.ones(2)))
