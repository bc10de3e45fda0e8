from dataclasses import replace
from math import inf, nan
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hardware.interface import DeviceState, JointStops
from hardware.robot_model import RobotTerms
from site_runtime.guard import Cut, Guard, GuardError, Limits

JOINTS = 3
TORQUE, SPEED = np.array([5.0, 3.0, 2.0]), np.array([2.0, 2.0, 4.0])
LOW, HIGH = np.array([0.1, -0.1]), np.array([0.6, 0.5])
PERIOD_S = 1e-3
UNLIMITED = Limits(
    torque_nm=np.full(3, inf),
    torque_rate_nm_s=np.full(3, inf),
    velocity_rad_s=np.full(3, inf),
    kinetic_energy_j=inf,
    workspace_min_m=np.full(2, -inf),
    workspace_max_m=np.full(2, inf),
    stops=JointStops.none(3),
    fault_after_s=inf,
)
LIMITED = replace(
    UNLIMITED, torque_nm=TORQUE, velocity_rad_s=SPEED, workspace_min_m=LOW, workspace_max_m=HIGH
)
STILL = DeviceState(np.zeros(3), np.zeros(3), np.zeros(6), 0)


def robot_at(
    q_dot: np.ndarray | None = None,
    gravity_nm: np.ndarray | None = None,
    q: np.ndarray | None = None,
    M: np.ndarray | None = None,
) -> RobotTerms:
    """What the guard looks at of a robot's terms; zeros and a unit inertia unless given."""
    none = np.zeros(3)
    terms = {
        "q": none if q is None else q,
        "q_dot": none if q_dot is None else q_dot,
        "G": none if gravity_nm is None else gravity_nm,
        "M": np.eye(3) if M is None else M,
    }
    return SimpleNamespace(**terms)  # type: ignore[return-value]


@pytest.fixture
def guard() -> Guard:
    return Guard(LIMITED, PERIOD_S)


def vectors(bound: float, length: int = JOINTS) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, length, elements=st.floats(-bound, bound))


def new_guard() -> Guard:
    return Guard(LIMITED, PERIOD_S)


def test_what_is_within_the_limits_passes_untouched_and_nothing_is_reported(guard: Guard) -> None:
    position, torque = np.array([0.1, 0.5]), np.array([5.0, -3.0, 0.0])
    assert np.array_equal(guard.target(position), position)
    assert np.array_equal(guard.torque(torque, robot_at(np.array([2.0, -2.0, 0.0]))), torque)
    assert guard.cut == Cut.NONE
    assert set(guard.counts.values()) == {0}


@pytest.mark.parametrize(
    ("torque", "expected"),
    [([5.1, 0.0, 0.0], [5.0, 0.0, 0.0]), ([0.0, -1e9, 2.5], [0.0, -3.0, 2.0])],
)
def test_torque_is_cut_joint_by_joint_and_counted(
    guard: Guard, torque: list[float], expected: list[float]
) -> None:
    for tick in range(1, 4):
        guard.reading(STILL)
        assert guard.torque(np.array(torque), robot_at()).tolist() == expected
        assert guard.cut == Cut.TORQUE
        assert guard.counts[Cut.TORQUE] == tick


def test_a_joint_too_fast_keeps_its_gravity_torque_and_only_what_brakes_it(guard: Guard) -> None:
    gravity, fast = np.array([1.0, 1.0, 1.0]), np.array([2.1, -2.1, 3.9])
    speeding_up = guard.torque(np.array([2.0, -2.0, 2.0]), robot_at(fast, gravity))
    assert speeding_up.tolist() == [1.0, 1.0, 2.0]  # the third is not too fast
    assert guard.cut == Cut.VELOCITY
    braking = np.array([0.5, 2.0, 2.0])
    assert np.array_equal(guard.torque(braking, robot_at(fast, gravity)), braking)
    assert guard.counts[Cut.VELOCITY] == 1


def test_the_cuts_of_one_tick_add_up_and_the_next_tick_starts_clean(guard: Guard) -> None:
    guard.target(np.array([9.0, 0.0]))
    guard.torque(np.array([9.0, -9.0, 0.0]), robot_at(np.array([0.0, -3.0, 0.0])))
    assert guard.cut == Cut.WORKSPACE | Cut.VELOCITY | Cut.TORQUE
    guard.reading(STILL)
    assert guard.cut == Cut.NONE
    counted = {cut for cut, count in guard.counts.items() if count == 1}
    assert counted == {Cut.TORQUE, Cut.VELOCITY, Cut.WORKSPACE}


@given(
    torque=vectors(1e6),
    velocity=vectors(10.0),
    gravity=arrays(np.float64, JOINTS, elements=st.floats(-1.0, 1.0)),
)
def test_never_beyond_the_torque_limit_and_never_faster_where_it_is_too_fast(
    torque: np.ndarray, velocity: np.ndarray, gravity: np.ndarray
) -> None:
    gravity = gravity * TORQUE  # what gravity takes, the motors can hold
    asked = torque.copy()
    limited = new_guard().torque(torque, robot_at(velocity, gravity))
    assert (np.abs(limited) <= TORQUE).all()
    too_fast = np.abs(velocity) > SPEED
    assert ((limited - gravity) * velocity <= 0.0)[too_fast].all()
    assert np.array_equal(limited[~too_fast], np.clip(torque, -TORQUE, TORQUE)[~too_fast])
    assert np.array_equal(torque, asked)  # what the controller said is left as it was


@given(position=vectors(3.0, 2), inside=arrays(np.float64, 2, elements=st.floats(0.0, 1.0)))
def test_the_target_is_the_nearest_point_of_the_workspace(
    position: np.ndarray, inside: np.ndarray
) -> None:
    guard = new_guard()
    target = guard.target(position)
    assert ((target >= LOW) & (target <= HIGH)).all()
    other = LOW + inside * (HIGH - LOW)
    assert np.linalg.norm(target - position) <= np.linalg.norm(other - position) + 1e-12
    assert (guard.cut == Cut.WORKSPACE) == bool((target != position).any())


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("limits", [LIMITED, UNLIMITED])
def test_a_torque_that_is_no_number_is_refused(bad: float, limits: Limits) -> None:
    with pytest.raises(GuardError, match=r"torque.*not finite"):
        Guard(limits, PERIOD_S).torque(np.array([0.0, bad, 0.0]), robot_at())


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize(
    ("field", "name"),
    [
        ("position_rad", "joint position"),
        ("velocity_rad_s", "joint velocity"),
        ("wrench", "wrench"),
    ],
)
def test_a_reading_that_is_no_number_is_refused(
    guard: Guard, bad: float, field: str, name: str
) -> None:
    values = {"position_rad": np.zeros(3), "velocity_rad_s": np.zeros(3), "wrench": np.zeros(6)}
    guard.reading(DeviceState(**values, stamp_ns=0))
    values[field][-1] = bad
    with pytest.raises(GuardError, match=rf"{name}.*not finite"):
        guard.reading(DeviceState(**values, stamp_ns=0))


def test_no_limits_cut_nothing() -> None:
    guard = Guard(UNLIMITED, PERIOD_S)
    far, strong = np.array([1e9, -1e9]), np.array([1e9, -1e9, 0.0])
    assert np.array_equal(guard.target(far), far)
    assert np.array_equal(guard.torque(strong, robot_at(np.full(3, 1e9))), strong)
    assert guard.cut == Cut.NONE
