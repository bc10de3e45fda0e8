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


GRAVITY = np.array([1.0, -2.0, 0.5])


def rate_guard(rate: float = 100.0) -> Guard:
    """0.1 N·m a tick."""
    return Guard(replace(UNLIMITED, torque_rate_nm_s=np.array([rate, rate, inf])), PERIOD_S)


def test_the_torque_rate_is_cut_beyond_gravity_and_gravity_is_exempt() -> None:
    guard = rate_guard()
    asked = np.add(GRAVITY, [0.1, -0.25, 7.0])
    assert guard.torque(asked, robot_at(None, GRAVITY)) == pytest.approx(
        np.add(GRAVITY, [0.1, -0.1, 7.0])
    )
    assert guard.cut == Cut.TORQUE_RATE
    # the arm turns over: gravity may change at any rate
    turned = -20.0 * GRAVITY
    within = guard.torque(np.add(turned, [0.19, -0.01, -7.0]), robot_at(None, turned))
    assert within == pytest.approx(np.add(turned, [0.19, -0.01, -7.0]))
    assert guard.counts[Cut.TORQUE_RATE] == 1


def test_after_a_restart_the_torque_starts_at_gravitys() -> None:
    guard = rate_guard()
    for _ in range(50):
        guard.torque(np.add(GRAVITY, [9.0, 0.0, 0.0]), robot_at(None, GRAVITY))
    assert guard.torque(np.add(GRAVITY, [9.0, 0.0, 0.0]), robot_at(None, GRAVITY))[
        0
    ] == pytest.approx(6.1)
    guard.restart()
    started = guard.torque(np.add(GRAVITY, [9.0, 0.0, 0.0]), robot_at(None, GRAVITY))
    assert started == pytest.approx(np.add(GRAVITY, [0.1, 0.0, 0.0]))


def test_the_rate_counts_from_what_was_really_commanded() -> None:
    guard = Guard(replace(LIMITED, torque_rate_nm_s=np.full(3, 1000.0)), PERIOD_S)
    for _ in range(20):
        guard.torque(np.array([20.0, 0.0, 0.0]), robot_at())
    # cut to 5 N·m by strength: back below it at once, not after 15 N·m of ticks
    assert guard.torque(np.array([4.5, 0.0, 0.0]), robot_at()).tolist() == [4.5, 0.0, 0.0]


@given(torques=st.lists(vectors(50.0), min_size=1, max_size=30), gravity=vectors(5.0))
def test_no_step_is_larger_than_the_rate_allows(torques: list, gravity: np.ndarray) -> None:
    guard, before = rate_guard(), np.zeros(3)
    for asked in torques:
        net = guard.torque(asked, robot_at(None, gravity)) - gravity
        assert (np.abs(net - before)[:2] <= 0.1 + 1e-12).all()
        before = net


INERTIA = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.5]])


@given(torque=vectors(10.0), velocity=vectors(2.0), gravity=vectors(5.0))
def test_above_the_energy_limit_no_power_is_fed_and_below_it_nothing_is_cut(
    torque: np.ndarray, velocity: np.ndarray, gravity: np.ndarray
) -> None:
    guard = Guard(replace(UNLIMITED, kinetic_energy_j=1.0), PERIOD_S)
    limited = guard.torque(torque, robot_at(velocity, gravity, M=INERTIA))
    asked_w = (torque - gravity) @ velocity
    energy_j = 0.5 * velocity @ INERTIA @ velocity
    if energy_j <= 1.0 or asked_w <= 0.0:
        assert limited == pytest.approx(torque, abs=1e-12)
        if energy_j <= 1.0 or asked_w < -1e-9:
            assert limited is torque
            assert guard.cut == Cut.NONE
        return
    assert (limited - gravity) @ velocity == pytest.approx(0.0, abs=1e-9)
    assert guard.cut == (Cut.KINETIC_ENERGY if asked_w > 1e-9 else guard.cut)
    # nothing but the component along the motion is taken
    taken = limited - torque
    assert taken - (taken @ velocity) / (velocity @ velocity) * velocity == pytest.approx(
        np.zeros(3), abs=1e-9
    )


def test_exactly_at_the_energy_limit_nothing_is_cut() -> None:
    guard = Guard(replace(UNLIMITED, kinetic_energy_j=2.0), PERIOD_S)
    asked = np.array([1.0, 0.0, 0.0])
    assert guard.torque(asked, robot_at(np.array([2.0, 0.0, 0.0]))) is asked
    fast = robot_at(np.array([np.nextafter(2.0, 3.0), 0.0, 0.0]))
    assert guard.torque(asked, fast).tolist() == [0.0, 0.0, 0.0]


def stops(*rows: tuple[list[float], float, float]) -> Limits:
    matrix, lower, upper = zip(*rows, strict=True)
    return replace(UNLIMITED, stops=JointStops(np.array(matrix), np.array(lower), np.array(upper)))


OWN = stops(([1.0, 0.0, 0.0], -1.0, 2.0))
COUPLED = stops(([0.0, 1.0, 1.0], -1.0, 2.0))


@pytest.mark.parametrize(
    ("q", "push", "expected"),
    [
        (2.0, 3.0, 0.0),
        (2.5, 3.0, 0.0),
        (np.nextafter(2.0, 0.0), 3.0, 3.0),
        (2.0, -3.0, -3.0),
        (-1.0, -3.0, 0.0),
        (-1.0, 3.0, 3.0),
        (np.nextafter(-1.0, 0.0), -3.0, -3.0),
    ],
)
def test_a_joint_at_its_stop_keeps_its_gravity_and_only_what_leads_back(
    q: float, push: float, expected: float
) -> None:
    guard = Guard(OWN, PERIOD_S)
    asked = np.add(GRAVITY, [push, 4.0, -4.0])
    limited = guard.torque(asked, robot_at(None, GRAVITY, np.array([q, 9.0, -9.0])))
    assert limited.tolist() == (np.add(GRAVITY, [expected, 4.0, -4.0])).tolist()
    assert guard.cut == (Cut.JOINT if expected != push else Cut.NONE)


@given(
    q=vectors(2.0),
    push=vectors(10.0),
    gravity=vectors(5.0),
    limits=st.sampled_from([OWN, COUPLED, stops(([2.0, -1.0, 0.5], -1.0, 1.0))]),
)
def test_at_a_stop_nothing_pushes_outward_and_inside_nothing_is_cut(
    q: np.ndarray, push: np.ndarray, gravity: np.ndarray, limits: Limits
) -> None:
    guard = Guard(limits, PERIOD_S)
    asked = gravity + push
    limited = guard.torque(asked, robot_at(None, gravity, q))
    row = limits.stops.matrix[0]
    at, low, high = row @ q, limits.stops.lower_rad[0], limits.stops.upper_rad[0]
    if low + 1e-9 < at < high - 1e-9:
        assert np.array_equal(limited, asked)
    if at >= high + 1e-9:
        assert (limited - gravity) @ row <= 1e-9
    if at <= low - 1e-9:
        assert (limited - gravity) @ row >= -1e-9
    # what slides along the stop is left
    taken = limited - asked
    assert taken - (taken @ row) / (row @ row) * row == pytest.approx(np.zeros(3), abs=1e-9)


def test_in_a_corner_one_stop_does_not_bring_back_what_the_other_took() -> None:
    """Joint 2's end, and a link that couples 2 and 3: one by one, each pushes into the other."""
    end, link = [0.0, 1.0, 0.0], [0.0, -1.0, 1.0]
    for rows in ((end, link), (link, end)):
        guard = Guard(stops(*((row, -inf, 0.0) for row in rows)), PERIOD_S)
        asked = np.add(GRAVITY, [2.0, 0.5, 1.0])
        limited = guard.torque(asked, robot_at(None, GRAVITY))
        assert limited == pytest.approx(np.add(GRAVITY, [2.0, 0.0, 0.0]), abs=1e-12)
        assert guard.cut == Cut.JOINT
        assert guard.counts[Cut.JOINT] == 1


ROWS = st.lists(
    arrays(np.float64, 3, elements=st.integers(-2, 2).map(float)).filter(np.any),
    min_size=1,
    max_size=4,
)


@given(rows=ROWS, push=vectors(10.0), gravity=vectors(5.0), inside=vectors(5.0))
def test_in_any_corner_the_torque_is_the_nearest_that_pushes_into_no_stop(
    rows: list, push: np.ndarray, gravity: np.ndarray, inside: np.ndarray
) -> None:
    guard = Guard(stops(*((row, -inf, 0.0) for row in rows)), PERIOD_S)
    net = guard.torque(gravity + push, robot_at(None, gravity)) - gravity
    A = np.array(rows)
    assert (A @ net <= 1e-9).all()
    # the nearest: any other allowed one, `inside` if it happens to be, lies beyond a right angle
    if (A @ inside <= 0.0).all():
        assert (push - net) @ (inside - net) <= 1e-6
    assert (push - net) @ (0.0 - net) <= 1e-6
    assert (push - net) @ net == pytest.approx(0.0, abs=1e-6)


ALL = Limits(
    torque_nm=TORQUE,
    torque_rate_nm_s=np.array([2000.0, 500.0, inf]),
    velocity_rad_s=SPEED,
    kinetic_energy_j=2.0,
    workspace_min_m=LOW,
    workspace_max_m=HIGH,
    stops=JointStops(
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 1.0]]),
        np.array([-1.0, -1.0, -1.0]),
        np.array([1.0, 1.0, 1.0]),
    ),
    fault_after_s=inf,
)


@given(
    ticks=st.lists(
        st.tuples(vectors(1e6) | vectors(8.0), vectors(6.0), vectors(2.0)), min_size=1, max_size=8
    ),
    gravity=arrays(np.float64, JOINTS, elements=st.floats(-1.0, 1.0)),
)
def test_all_limits_hold_together(ticks: list, gravity: np.ndarray) -> None:
    guard, gravity = Guard(ALL, PERIOD_S), gravity * TORQUE
    for torque, velocity, q in ticks:
        guard.reading(STILL)
        limited = guard.torque(torque, robot_at(velocity, gravity, q, INERTIA))
        assert np.isfinite(limited).all()
        assert (np.abs(limited) <= TORQUE).all()
        net, rounding = limited - gravity, 1e-9 * max(1.0, float(np.abs(torque).max()))
        too_fast = np.abs(velocity) > SPEED
        assert ((net * velocity)[too_fast] <= rounding).all()
        if 0.5 * velocity @ INERTIA @ velocity > 2.0:
            assert net @ velocity <= rounding
        at = ALL.stops.matrix @ q
        assert ((ALL.stops.matrix @ net)[at >= 1.0 + 1e-9] <= rounding).all()
        assert ((ALL.stops.matrix @ net)[at <= -1.0 - 1e-9] >= -rounding).all()


def test_where_one_joints_strength_would_unhold_another_all_are_weakened_alike() -> None:
    limits = replace(stops(([1.0, 1.0, 0.0], -inf, 0.0)), torque_nm=np.array([20.0, 5.0, 9.0]))
    guard = Guard(limits, PERIOD_S)
    limited = guard.torque(np.array([10.0, -10.0, 4.0]), robot_at())
    assert limited == pytest.approx([5.0, -5.0, 2.0])  # not 10 and −5: that pushes into the stop
    assert guard.cut == Cut.TORQUE


def test_a_robot_whose_weight_is_beyond_its_strength_does_its_best() -> None:
    limits = replace(stops(([1.0, 1.0, 0.0], -inf, 0.0)), torque_nm=np.full(3, 5.0))
    heavy = np.array([10.0, 0.0, 0.0])
    limited = Guard(limits, PERIOD_S).torque(np.array([7.0, 3.0, 0.0]), robot_at(None, heavy))
    assert (np.abs(limited) <= 5.0).all()


def cut_by(cut: Cut, limits: Limits) -> tuple[np.ndarray, RobotTerms]:
    """Return a command that is cut by this limit alone."""
    push, fast = np.array([1.0, 0.0, 0.0]), np.array([1.5, 0.0, 0.0])
    return {
        Cut.TORQUE: (100.0 * push, robot_at()),
        Cut.TORQUE_RATE: (4.0 * push, robot_at()),
        Cut.VELOCITY: (push, robot_at(2.0 * fast)),
        Cut.KINETIC_ENERGY: (push, robot_at(fast)),
        Cut.JOINT: (push, robot_at(q=np.array([3.0, 0.0, 0.0]))),
    }[cut]


FAULTS = {
    Cut.TORQUE: replace(LIMITED, fault_after_s=0.05),
    Cut.TORQUE_RATE: replace(UNLIMITED, torque_rate_nm_s=np.full(3, 1e-6), fault_after_s=0.05),
    Cut.VELOCITY: replace(LIMITED, fault_after_s=0.05),
    Cut.KINETIC_ENERGY: replace(UNLIMITED, kinetic_energy_j=1.0, fault_after_s=0.05),
    Cut.JOINT: replace(OWN, fault_after_s=0.05),
}


@pytest.mark.parametrize("cut", set(FAULTS) - {Cut.JOINT}, ids=lambda cut: str(cut.name))
def test_cuts_for_longer_than_fault_after_s_are_a_fault(cut: Cut) -> None:
    guard = Guard(FAULTS[cut], PERIOD_S)
    asked, terms = cut_by(cut, FAULTS[cut])
    for _ in range(50):
        guard.reading(STILL)
        guard.torque(asked, terms)
        assert guard.cut == cut
    with pytest.raises(GuardError, match=str(cut.name).lower().replace("_", " ")):
        guard.torque(asked, terms)


@pytest.mark.parametrize("rate_hz", [10, 300, 500, 1000, 3000, 10_000])
@pytest.mark.parametrize("fault_after_s", [0.1, 0.3, 0.7, 1.0])
def test_the_fault_comes_at_the_very_tick(rate_hz: int, fault_after_s: float) -> None:
    guard = Guard(replace(LIMITED, fault_after_s=fault_after_s), round(1e9 / rate_hz) * 1e-9)
    ticks = round(fault_after_s * rate_hz)
    for _ in range(ticks):
        guard.torque(np.array([9.0, 0.0, 0.0]), robot_at())
    with pytest.raises(GuardError):
        guard.torque(np.array([9.0, 0.0, 0.0]), robot_at())


def test_the_excess_leaks_and_a_restart_forgets_it() -> None:
    guard = Guard(FAULTS[Cut.TORQUE], PERIOD_S)
    strong, weak = np.array([9.0, 0.0, 0.0]), np.zeros(3)
    histories = ([strong] * 50 + [weak] * 20 + [strong] * 20, [strong, weak] * 200 + [strong] * 50)
    for history in histories:
        for torque in history:
            guard.reading(STILL)
            guard.torque(torque, robot_at())
        guard.reading(STILL)
        with pytest.raises(GuardError):
            guard.torque(strong, robot_at())
        guard.restart()


@pytest.mark.parametrize("cut", [Cut.JOINT, Cut.WORKSPACE], ids=lambda cut: str(cut.name))
def test_a_hand_may_lean_on_a_stop_or_the_workspace_for_ever(cut: Cut) -> None:
    guard = Guard(replace(FAULTS[Cut.JOINT], workspace_max_m=HIGH), PERIOD_S)
    asked, terms = cut_by(Cut.JOINT, OWN)
    for _ in range(1000):
        guard.reading(STILL)
        if cut is Cut.WORKSPACE:
            guard.target(np.array([9.0, 9.0]))
            guard.torque(np.zeros(3), robot_at())
        else:
            guard.torque(asked, terms)
        assert guard.cut == cut
