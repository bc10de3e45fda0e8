from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from control_law.ramp import smooth_ramp
from local_site.operators import ConstantForce, HumanArm, PulsedForce, build_operator
from site_runtime.session import (
    ConstantOperator,
    HumanArmOperator,
    NoOperator,
    Pulse,
    PulsesOperator,
)

ORIGIN, REST = np.zeros(2), np.zeros(2)
HAND = HumanArmOperator(
    kind="human_arm",
    stiffness_n_per_m=400.0,
    damping_n_s_per_m=20.0,
    force_limit_n=25.0,
    center_m=(0.4, 0.2),
    amplitude_m=(0.13, 0.09),
    frequency_hz=(0.2, 0.4),
    phase_rad=(0.0, 0.7),
    start_s=0.5,
    grip_s=1.0,
)
GRIPPED_S = HAND.start_s + HAND.grip_s


def path_m(time_s: float) -> np.ndarray:
    return np.array(
        [
            center + amplitude * np.sin(2 * np.pi * frequency * time_s + phase)
            for center, amplitude, frequency, phase in zip(
                HAND.center_m, HAND.amplitude_m, HAND.frequency_hz, HAND.phase_rad, strict=True
            )
        ]
    )


def path_m_s(time_s: float) -> np.ndarray:
    return (path_m(time_s + 1e-6) - path_m(time_s - 1e-6)) / 2e-6


@pytest.mark.parametrize(
    ("settings", "kind"),
    [
        (ConstantOperator("constant", (1.0, 2.0)), ConstantForce),
        (PulsesOperator("pulses", (Pulse("x", 1.0, 0.0, 1.0),)), PulsedForce),
        (HAND, HumanArm),
    ],
)
def test_each_kind_of_operator_is_built_in_the_tasks_dimension(
    settings: object, kind: type
) -> None:
    operator = build_operator(settings, 2)  # type: ignore[arg-type]
    assert isinstance(operator, kind)
    assert operator.force_n(0.7, ORIGIN, REST).shape == (2,)


def test_nobody_pushes() -> None:
    assert build_operator(NoOperator("none"), 3) is None


def test_a_constant_force_starts_at_its_time() -> None:
    operator = build_operator(ConstantOperator("constant", (1.0, -2.0), start_s=3.0), 2)
    assert operator.force_n(np.nextafter(3.0, 0.0), ORIGIN, REST).tolist() == [0.0, 0.0]
    assert operator.force_n(3.0, ORIGIN, REST).tolist() == [1.0, -2.0]


def test_pulses_rise_to_their_force_at_half_time_and_are_over_at_the_end() -> None:
    operator = PulsedForce((Pulse("y", -2.0, 1.0, 3.0),), 2)
    heights = [operator.force_n(t, ORIGIN, REST)[1] for t in (0.9, 1.0, 1.5, 2.0, 2.5, 3.0, 9.0)]
    assert heights == pytest.approx([0.0, 0.0, -1.0, -2.0, -1.0, 0.0, 0.0])
    assert operator.force_n(2.0, ORIGIN, REST)[0] == 0.0


def test_pulses_that_overlap_add_up() -> None:
    operator = PulsedForce((Pulse("x", 1.0, 0.0, 2.0), Pulse("x", 2.0, 0.0, 2.0)), 3)
    assert operator.force_n(1.0, np.zeros(3), np.zeros(3)).tolist() == pytest.approx([3.0, 0, 0])


def test_the_third_axis_can_be_pushed_too() -> None:
    operator = PulsedForce((Pulse("z", 5.0, 0.0, 2.0),), 3)
    assert operator.force_n(1.0, np.zeros(3), np.zeros(3)).tolist() == [0.0, 0.0, 5.0]


@given(time_s=st.floats(GRIPPED_S, 60.0))
def test_a_hand_on_its_path_exerts_no_force(time_s: float) -> None:
    force = HumanArm(HAND).force_n(time_s, path_m(time_s), path_m_s(time_s))
    assert np.linalg.norm(force) < 1e-5


def test_off_its_path_it_is_a_spring_and_a_damper() -> None:
    hand, time_s = HumanArm(HAND), 7.3
    position, velocity = path_m(time_s), path_m_s(time_s)
    aside = np.array([0.01, -0.02])
    assert hand.force_n(time_s, position + aside, velocity) == pytest.approx(
        -400.0 * aside, abs=1e-5
    )
    faster = np.array([0.1, 0.2])
    assert hand.force_n(time_s, position, velocity + faster) == pytest.approx(
        -20.0 * faster, abs=1e-5
    )


@given(
    time_s=st.floats(-5.0, 60.0),
    position=st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
    velocity=st.tuples(st.floats(-99, 99), st.floats(-99, 99)),
)
def test_a_hand_is_no_stronger_than_its_limit(
    time_s: float, position: tuple[float, float], velocity: tuple[float, float]
) -> None:
    force = HumanArm(HAND).force_n(time_s, np.array(position), np.array(velocity))
    assert np.linalg.norm(force) <= HAND.force_limit_n * (1 + 1e-12)


def test_at_its_limit_it_pulls_straight_to_the_path() -> None:
    hand, time_s = HumanArm(HAND), 7.3
    aside = np.array([0.3, -0.4])
    force = hand.force_n(time_s, path_m(time_s) + aside, path_m_s(time_s))
    assert force == pytest.approx([-25.0 * 0.6, 25.0 * 0.8], abs=1e-4)


@given(
    size=st.tuples(st.floats(0.001, 0.5), st.floats(0.001, 0.5)),
    phase_rad=st.floats(0.0, 6.0),
    rate_rad_s=st.floats(0.1, 50.0),
)
def test_a_hand_that_stands_still_is_passive_at_its_limit_too(
    size: tuple[float, float], phase_rad: float, rate_rad_s: float
) -> None:
    hand = HumanArm(replace(HAND, amplitude_m=(0.0, 0.0)))
    work = []
    for angle in np.linspace(0.0, 2 * np.pi, 300, endpoint=False):
        angles = angle + np.array([0.0, phase_rad])
        position = np.array(HAND.center_m) + np.array(size) * np.sin(angles)
        velocity = rate_rad_s * np.array(size) * np.cos(angles)
        work.append(hand.force_n(GRIPPED_S, position, velocity) @ velocity)
    assert sum(work) <= 1e-3 * np.abs(work).sum()


def test_it_takes_hold_smoothly_from_its_start_on() -> None:
    hand = HumanArm(HAND)

    def force(time_s: float) -> np.ndarray:
        return hand.force_n(time_s, path_m(time_s) - [0.01, 0.0], path_m_s(time_s))

    assert not force(HAND.start_s - 1.0).any()
    assert not force(HAND.start_s).any()
    for after_s in (0.25, 0.5, 1.0, 4.0):
        share, _ = smooth_ramp(after_s, HAND.grip_s)
        assert force(HAND.start_s + after_s) == pytest.approx([4.0 * share, 0.0], abs=1e-5)
