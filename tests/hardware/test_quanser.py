"""The driver "quanser" against a fake board: units, order of calls, limits, and every fault."""

import itertools
import mmap
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.interface import DeviceConfigurationError, DeviceError, VelocityByDifference
from hardware.quanser import IDLE_STALE_S, QuanserDevice
from hardware.quanser_current_limit import FADE_S, CurrentLimit
from tests.fakes import quanser_hardware as fake
from tests.fakes.quanser_bench import QuanserBench, settings_of

TORQUE = np.array([0.05, -0.03])


@pytest.fixture(autouse=True)
def _no_board_is_left() -> Iterator[None]:
    yield
    fake.disconnect_all()


@pytest.fixture
def make() -> Iterator[Callable[..., QuanserBench]]:
    made: list[QuanserBench] = []

    def make(**changes: Any) -> QuanserBench:
        made.append(QuanserBench(**changes))
        return made[-1]

    yield make
    for bench in made:
        bench.device.close()


@pytest.fixture
def bench(make: Callable[..., QuanserBench]) -> QuanserBench:
    bench = make()
    bench.device.open()
    return bench


@pytest.fixture
def enabled(bench: QuanserBench) -> QuanserBench:
    bench.run(3)
    bench.device.enable()
    bench.run(3, TORQUE)
    return bench


# Units, signs and time


def test_positions_are_the_robots_from_its_reference_pose(bench: QuanserBench) -> None:
    np.testing.assert_allclose(bench.device.read().position_rad, (0.4, -0.7), atol=1e-12)
    bench.plant.hand_nm = [0.02, -0.05]
    states = bench.run(300)
    resolution = 1.0 / min(bench.robot.counts_per_rad)
    moved = states[-1].position_rad - states[0].position_rad
    assert (np.abs(moved) > 20 * resolution).all()
    np.testing.assert_allclose(
        states[-1].position_rad, bench.position_rad(), rtol=0, atol=3 * resolution
    )


def test_velocity_is_the_filtered_difference_over_the_boards_period(
    make: Callable[..., QuanserBench],
) -> None:
    bench = make(velocity_filter_s=0.004)
    assert isinstance(bench.settings, VelocityByDifference)
    assert bench.settings.difference_filter_s == 0.004
    bench.device.open()
    bench.plant.hand_nm = [0.05, -0.05]
    states = bench.run(100)
    expected = np.zeros(2)
    weight = 0.001 / (0.001 + 0.004)
    for before, state in itertools.pairwise(states):
        step = (state.position_rad - before.position_rad) / 0.001
        expected = expected + weight * (step - expected)
        np.testing.assert_allclose(state.velocity_rad_s, expected, atol=1e-9)
    assert np.abs(expected).min() > 0.05


def test_torque_is_what_the_joints_get(enabled: QuanserBench) -> None:
    np.testing.assert_allclose(enabled.torque_nm(), TORQUE, atol=1e-12)
    np.testing.assert_allclose(enabled.board.torque_nm(), enabled.drive.T @ TORQUE, atol=1e-12)


def test_power_is_that_of_the_robots_joints(enabled: QuanserBench) -> None:
    """Signs, gains and drive matrix agree between what is read and what is written."""
    enabled.run(200, TORQUE)
    before, phi_before = enabled.device.read(), np.array(enabled.plant.angle_rad())
    enabled.run(100, TORQUE)
    after, phi_after = enabled.device.read(), np.array(enabled.plant.angle_rad())
    work = TORQUE @ (after.position_rad - before.position_rad)
    assert work > 0.0
    np.testing.assert_allclose(
        work, np.array(enabled.board.torque_nm()) @ (phi_after - phi_before), rtol=0.05
    )


def test_stamps_are_the_boards_however_late_the_samples_are_fetched(bench: QuanserBench) -> None:
    promptly = bench.run(20)
    stamps = np.array([state.stamp_ns for state in promptly])
    np.testing.assert_allclose(np.diff(stamps), 1e6, atol=1e3)
    bench.board.pass_time(0.05)  # the thread gets all fifty at once, 50 ms after the first
    state = bench.device.read()
    assert state.stamp_ns == pytest.approx(bench.time.ns, abs=2e4)
    assert state.stamp_ns <= bench.time.ns
    # One sample less than all of them would be a stamp of the past, not of its arrival.
    bench.board.pass_time(0.0105)
    assert bench.device.read().stamp_ns == pytest.approx(bench.time.ns - 500_000, abs=3e4)


def test_a_late_first_sample_does_not_make_stamps_run_backwards(
    make: Callable[..., QuanserBench],
) -> None:
    bench = make()
    bench.device.open()
    bench.board.pass_time(0.0059)  # five samples, the first of them 4.9 ms late
    stamps = [bench.device.read().stamp_ns]
    for _ in range(20):
        bench.board.pass_time(0.001)
        stamps.append(bench.device.read().stamp_ns)
    assert (np.diff(stamps) >= 0).all()
    assert all(stamp <= bench.time.ns for stamp in stamps)
    assert bench.time.ns - stamps[-1] < 1_000_000


def test_torque_ramps_in_after_every_enable(make: Callable[..., QuanserBench]) -> None:
    bench = make(torque_ramp_s=0.1)
    bench.device.open()
    for _ in range(2):
        bench.device.enable()
        for tick in range(1, 131):
            bench.run(1, TORQUE)
            share = min(tick / 100, 1.0)
            np.testing.assert_allclose(bench.torque_nm(), share * TORQUE, atol=1e-9)
        bench.device.enable()
    bench.run(10, TORQUE)
    np.testing.assert_allclose(bench.torque_nm(), 0.1 * TORQUE, atol=1e-9)


def test_in_real_time_a_read_waits_for_nothing_and_samples_come(
    make: Callable[..., QuanserBench],
) -> None:
    bench = make()
    board = fake.connect(fake.Board(bench.robot, bench.plant))
    device = QuanserDevice(replace(bench.settings, watchdog_s=0.1), time.monotonic_ns)
    device.open()
    stamps = {device.read().stamp_ns}
    reads = 0
    while len(stamps) < 50:
        stamps.add(device.read().stamp_ns)
        reads += 1
    assert reads > 2 * len(stamps)  # it did not wait for them
    device.close()
    assert board.calls[-1] == "close"


# The order of calls


def test_opening_makes_safe_first_and_enabling_switches_on_last(bench: QuanserBench) -> None:
    calls = bench.board.calls
    assert calls == [
        "open",
        "directions",
        "amplifiers off",
        "ranges",
        "write 0 V",
        "analog expiration",
        "digital expiration",
        "quadrature",
        "zero counts",
        "create task",
        "start task",
    ]
    calls.clear()
    bench.device.enable()
    assert calls == ["write 0 V", "start watchdog", "amplifiers on"]


def test_stop_leads_back_to_what_open_left(enabled: QuanserBench) -> None:
    enabled.board.calls.clear()
    enabled.device.stop()
    assert enabled.board.calls == ["write 0 V", "amplifiers off", "stop watchdog"]
    assert not any(enabled.board.amplifiers_on())
    assert not enabled.board.watchdog_runs()
    enabled.wait(0.2)  # longer than the watchdog
    assert enabled.device.read().stamp_ns > 0


def test_close_ends_everything_in_order(enabled: QuanserBench) -> None:
    enabled.board.calls.clear()
    enabled.device.close()
    assert enabled.board.calls == [
        "write 0 V",
        "amplifiers off",
        "stop task",
        "delete task",
        "stop watchdog",
        "close",
    ]


def test_encoders_are_zeroed_with_amplifiers_off_and_only_if_asked(
    make: Callable[..., QuanserBench],
) -> None:
    bench = make(zero_at_open=False)
    bench.device.open()
    assert "zero counts" not in bench.board.calls
    phi = np.floor(0.3 * np.array(bench.robot.counts_per_rad)) / bench.robot.counts_per_rad
    np.testing.assert_allclose(
        bench.device.read().position_rad, np.array((0.4, -0.7)) + bench.drive @ phi, atol=1e-3
    )


def test_an_arm_that_moves_while_it_is_zeroed_is_refused(
    make: Callable[..., QuanserBench],
) -> None:
    bench = make()
    bench.board.freeze_encoder(1)  # keeps its counts whatever is set
    with pytest.raises(DeviceError, match="reference pose"):
        bench.device.open()
    assert bench.board.calls[-1] == "close"
    assert bench.board.owner is None


# The fake is strict where the vendor's module is silently wrong


@pytest.mark.parametrize(
    ("buffer", "error"),
    [
        (np.zeros(2), TypeError),
        (np.zeros(2, np.int64), TypeError),
        (np.zeros(4, np.int32)[::2], ValueError),
        (np.zeros(3, np.int32), ValueError),
        ([0, 0], TypeError),
    ],
)
def test_the_fake_refuses_what_c_would_misread(buffer: object, error: type[Exception]) -> None:
    board = fake.connect(fake.Board())
    card = fake.HIL("q8_usb", "0")
    with pytest.raises(error):
        card.read_encoder(np.array([0, 2], np.uint32), 2, buffer)
    good = np.zeros(2, np.int32)
    card.read_encoder(np.array([0, 2], np.uint32), 2, good)
    assert good.any()
    with pytest.raises(TypeError):
        card.read_encoder(buffer, 2, good)  # channels are unsigned
    card.close()
    assert board.owner is None


def test_a_q8_keeps_its_outputs_on_expiry_unless_both_states_are_set() -> None:
    clock = fake.ManualTime()
    for states, left_v in (
        ((), 1.0),
        (("analog",), 1.0),
        (("digital",), 1.0),
        (("analog", "digital"), 0.0),
    ):
        board = fake.connect(fake.Board(now_ns=clock))
        card = fake.HIL("q8_usb", "0")
        channels, n = np.array([0, 1], np.uint32), 2
        card.set_digital_directions(None, 0, channels, n)
        card.write_digital(channels, n, np.ones(n, np.int8))
        if "analog" in states:
            card.watchdog_set_analog_expiration_state(channels, n, np.zeros(n))
        if "digital" in states:
            card.watchdog_set_digital_expiration_state(channels, n, np.full(n, 2, np.int32))
        card.write_analog(channels, n, np.ones(n))
        card.watchdog_start(0.02)
        board.pass_time(0.03)
        assert board.current_a() == [0.5 * left_v] * 2
        with pytest.raises(fake.HILError):
            card.write_analog(channels, n, np.ones(n))
        card.close()


# Faults: what is injected, and what it leads to


def unplugged(bench: QuanserBench) -> None:
    bench.board.unplug()


def expired(bench: QuanserBench) -> None:
    bench.board.expire_watchdog()


def overflowed(bench: QuanserBench) -> None:
    bench.board.overflow()


def garbage_counts(bench: QuanserBench) -> None:
    bench.board.jump(0, 12_345)


def frozen_clock(bench: QuanserBench) -> None:
    bench.board.freeze_clock()


def stalled_site(bench: QuanserBench) -> None:
    bench.wait(0.05)


FAULTS: dict[Callable[[QuanserBench], None], str] = {
    unplugged: "no longer answers",
    expired: "watchdog expired",
    overflowed: r"overflowed.*-111.*in time",
    garbage_counts: "jumped by",
    frozen_clock: "no sample for",
    stalled_site: "watchdog expired",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_a_fault_ends_torque_and_latches_until_the_device_is_opened_again(
    enabled: QuanserBench, fault: Callable[[QuanserBench], None]
) -> None:
    device = enabled.device
    fault(enabled)
    with pytest.raises(DeviceError, match=FAULTS[fault]):
        enabled.run(40, TORQUE)
    enabled.wait(enabled.settings.watchdog_s)  # what cannot be reached any more, the board ends
    assert enabled.board.torque_nm() == pytest.approx([0.0, 0.0])
    if fault is not unplugged and "expired" not in FAULTS[fault]:
        assert not any(enabled.board.amplifiers_on())
    for attempt in (device.read, device.enable, lambda: device.write(TORQUE)):
        with pytest.raises(DeviceError, match=FAULTS[fault]):
            attempt()
    device.stop()
    device.stop()
    with pytest.raises(DeviceError, match=FAULTS[fault]):
        device.enable()
    device.close()
    enabled.board.plug()
    enabled.board.clock_frozen = False
    device.open()
    enabled.run(3)
    assert not any(enabled.board.amplifiers_on())
    device.enable()
    enabled.run(3, TORQUE)
    np.testing.assert_allclose(enabled.torque_nm(), TORQUE, atol=1e-12)


@pytest.mark.parametrize("fault", [unplugged, overflowed, garbage_counts], ids=lambda f: f.__name__)
def test_a_fault_is_seen_by_read_while_outputs_are_off(
    bench: QuanserBench, fault: Callable[[QuanserBench], None]
) -> None:
    bench.run(3)
    fault(bench)
    with pytest.raises(DeviceError, match=FAULTS[fault]):
        bench.run(3)


def test_samples_that_stay_away_are_a_fault_sooner_while_torque_flows(
    bench: QuanserBench,
) -> None:
    bench.run(3)
    bench.board.freeze_clock()
    bench.run(round(IDLE_STALE_S / 0.001) - 10)
    with pytest.raises(DeviceError, match="no sample"):
        bench.run(20)


def test_a_process_that_stalled_gets_one_tick_to_catch_up(enabled: QuanserBench) -> None:
    """The tick may run before the thread does: one old sample is returned, not a fault."""
    device, fresh = enabled.device, enabled.device.read()
    enabled.time.ns += 25_000_000  # time passes and the thread has not been told
    enabled.board._deadline_ns = None  # the watchdog is another test's
    assert device.read().stamp_ns == fresh.stamp_ns
    enabled.tick()
    assert device.read().stamp_ns > fresh.stamp_ns
    enabled.tick()
    device.read()


def test_an_expired_board_is_opened_again_with_its_outputs_off(enabled: QuanserBench) -> None:
    """An expiry outlives the program; clearing it may switch the amplifiers back on."""
    enabled.board.expire_watchdog()
    enabled.device.close()
    enabled.board.calls.clear()
    enabled.device.open()
    assert enabled.board.calls[:4] == ["open", "clear watchdog", "directions", "amplifiers off"]
    assert not any(enabled.board.amplifiers_on())


def test_a_broken_amplifier_and_a_frozen_encoder_are_not_seen(enabled: QuanserBench) -> None:
    """Said in the documentation: the board tells of neither."""
    enabled.board.break_amplifier(0)
    enabled.board.freeze_encoder(1)
    enabled.run(20, TORQUE)
    assert enabled.board.current_a()[0] == 0.0
    assert enabled.board.current_a()[1] != 0.0


def test_stop_never_raises_on_a_board_that_does_not_answer(enabled: QuanserBench) -> None:
    enabled.board.unplug()
    enabled.device.stop()
    enabled.device.close()
    enabled.device.close()


def test_the_watchdog_is_stopped_only_on_a_board_that_is_safe(
    enabled: QuanserBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board that refuses its outputs keeps the watchdog, which then does what was refused."""

    def refuse(*_: object) -> None:
        raise fake.HILError(-4)

    monkeypatch.setattr(fake.HIL, "write_analog", refuse)
    enabled.device.stop()
    assert enabled.board.watchdog_runs()
    enabled.wait(enabled.settings.watchdog_s)
    assert enabled.board.current_a() == [0.0, 0.0]


def test_a_task_is_freed_once_nobody_waits_in_it(enabled: QuanserBench) -> None:
    enabled.board.freeze_clock()  # the thread waits for a sample that does not come
    enabled.device.close()
    assert enabled.board.calls[-4:] == ["stop task", "delete task", "stop watchdog", "close"]


def test_a_task_in_which_somebody_still_waits_is_not_freed(enabled: QuanserBench) -> None:
    enabled.board.freeze_clock()
    enabled.board.hung = True
    enabled.device.close()
    assert enabled.board.calls[-3:] == ["stop task", "stop watchdog", "close"]
    enabled.board.hung = False
    with enabled.board.changed:
        enabled.board.changed.notify_all()


# What is missing


def test_a_missing_module_is_explained() -> None:
    device = QuanserDevice(settings_of(fake.Robot(), module="no_such_vendor.hardware"), int)
    with pytest.raises(DeviceError, match=r"no_such_vendor.*Quanser SDK"):
        device.open()
    device.close()


def test_a_missing_shared_library_is_explained(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "vendor_without_library.py").write_text("raise OSError('libhil.so: not found')")
    monkeypatch.syspath_prepend(tmp_path)
    device = QuanserDevice(settings_of(fake.Robot(), module="vendor_without_library"), int)
    with pytest.raises(DeviceError, match=r"libhil\.so.*Quanser SDK"):
        device.open()


def test_the_vendors_module_is_not_imported_before_open() -> None:
    QuanserDevice(settings_of(fake.Robot(), module="quanser.hardware"), int)
    assert "quanser.hardware" not in sys.modules


def test_a_board_that_is_not_there_or_taken_is_explained(bench: QuanserBench) -> None:
    with pytest.raises(DeviceError, match=r"q4 '7'.*could not be found.*-108.*connected"):
        QuanserDevice(replace(bench.settings, board_type="q4", board_id="7"), int).open()
    with pytest.raises(DeviceError, match=r"in use.*-110.*another program"):
        QuanserDevice(bench.settings, int).open()
    bench.run(3)  # and the one that has it is not disturbed


def test_a_channel_that_the_board_lacks_is_explained(make: Callable[..., QuanserBench]) -> None:
    bench = make(encoder_channels=(0, 42))
    with pytest.raises(DeviceError, match=r"invalid.*-4"):
        bench.device.open()
    assert bench.board.calls[-1] == "close"


# Current limits


def test_no_motor_gets_more_than_its_peak_nor_for_ever_more_than_its_continuous_current(
    enabled: QuanserBench,
) -> None:
    enabled.plant.locked = [True, True]
    hard = np.array([9.0, -9.0])
    first = enabled.run(1, hard)
    assert first
    assert [abs(a) for a in enabled.board.current_a()] == pytest.approx([2.0, 2.0])
    for _ in range(6):
        enabled.run(500, hard)
    assert [abs(a) for a in enabled.board.current_a()] == pytest.approx([1.0, 0.8], rel=1e-3)
    assert enabled.board.largest_current_a == pytest.approx([2.0, 2.0])
    enabled.device.stop()
    enabled.device.enable()  # stopping does not cool a motor
    enabled.run(1, hard)
    assert abs(enabled.board.current_a()[0]) < 1.3


def test_a_motor_cools_while_outputs_are_off(enabled: QuanserBench) -> None:
    enabled.plant.locked = [True, True]
    hard = np.array([9.0, -9.0])
    enabled.run(2000, hard)
    assert abs(enabled.board.current_a()[0]) < 1.3
    enabled.device.stop()
    enabled.wait(1.0)
    enabled.device.enable()
    enabled.run(1, hard)
    assert abs(enabled.board.current_a()[0]) == pytest.approx(2.0)


currents = st.floats(0.05, 10.0)


@settings(deadline=None)
@given(
    continuous=currents,
    ratio=st.floats(1.0, 8.0),
    time_s=st.floats(0.2, 100.0),
    demands=st.lists(
        st.tuples(st.floats(-50.0, 50.0), st.floats(1e-4, FADE_S)), min_size=1, max_size=200
    ),
)
def test_the_limit_holds_whatever_is_demanded(
    continuous: float, ratio: float, time_s: float, demands: list[tuple[float, float]]
) -> None:
    limit = CurrentLimit(ratio * continuous, continuous, time_s)
    for wanted, elapsed in demands:
        current = limit.apply(wanted)
        assert abs(current) <= ratio * continuous
        assert abs(current) <= abs(wanted)
        assert current * wanted >= 0.0
        if abs(wanted) <= continuous:
            assert current == pytest.approx(wanted)  # what is borne for ever is never cut
        limit.pass_time(elapsed)
        assert limit.heat_a2 <= continuous**2 * (1.0 + 1e-9)


@settings(deadline=None)
@given(peak=st.floats(1.1, 4.0), time_s=st.floats(2.0, 20.0))
def test_the_peak_lasts_as_long_as_the_formula_says_and_then_fades_to_the_continuous_current(
    peak: float, time_s: float
) -> None:
    step_s = time_s / 1000.0
    limit = CurrentLimit(peak, 1.0, time_s)
    at_peak_s = time_s * np.log(peak**2 / (peak**2 - 1.0))
    cut_s, elapsed_s, current = None, 0.0, peak
    while elapsed_s < at_peak_s + 10.0 * FADE_S * peak**2:
        before, current = current, limit.apply(100.0)
        assert current <= before + 1e-12
        if cut_s is None and current < peak:
            cut_s = elapsed_s
        limit.pass_time(step_s)
        elapsed_s += step_s
    assert cut_s is not None
    assert cut_s <= at_peak_s
    # Heat rises at most by (p² − h)/τ: what is missing of the peak's time is within the fade.
    assert cut_s >= at_peak_s - FADE_S * peak**2 - step_s
    assert current == pytest.approx(1.0, rel=2e-2)


def test_heat_follows_the_first_order_filter_exactly() -> None:
    limit = CurrentLimit(3.0, 2.0, 4.0)
    limit.apply(1.5)
    limit.pass_time(1.0)
    assert limit.heat_a2 == pytest.approx(1.5**2 * (1.0 - np.exp(-1.0 / 4.0)))
    limit.apply(0.0)
    limit.pass_time(2.0)
    assert limit.heat_a2 == pytest.approx(1.5**2 * (1.0 - np.exp(-1.0 / 4.0)) * np.exp(-2.0 / 4.0))


def test_a_motor_that_is_too_hot_by_a_stall_gets_less_than_it_bears() -> None:
    limit = CurrentLimit(4.0, 1.0, 2.0)
    limit.apply(4.0)
    limit.pass_time(1.0)  # nobody limited it meanwhile
    assert limit.heat_a2 > 1.0
    assert limit.limit_a < 1.0


# Settings


def stops(low: tuple[float, ...], high: tuple[float, ...]) -> dict[str, Any]:
    return {"joint_min_rad": low, "joint_max_rad": high}


def test_stops_are_those_of_the_settings_on_the_joints_it_presents() -> None:
    given = QuanserBench(**stops((-1.0, -1.5), (0.5, 0.25))).device.joint_stops
    np.testing.assert_array_equal(given.matrix, np.eye(2))
    np.testing.assert_array_equal(given.lower_rad, (-1.0, -1.5))
    np.testing.assert_array_equal(given.upper_rad, (0.5, 0.25))
    assert QuanserBench().device.joint_stops.matrix.shape == (0, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"counts_per_rad": (6000.0,)}, "counts_per_rad has 1 items, encoder_channels has 2"),
        ({"encoder_channels": ()}, "one per joint"),
        ({"encoder_channels": (0, 0)}, "no two alike"),
        ({"analog_channels": (0, -1)}, "whole numbers from 0"),
        ({"enable_channels": ()}, "cannot be switched off"),
        ({"encoder_signs": (1, 0)}, r"encoder_signs is \(1, 0\); 1 or -1"),
        ({"motor_signs": (1, 2)}, "motor_signs"),
        ({"counts_per_rad": (6000.0, 0.0)}, "must be positive"),
        ({"thermal_time_s": (np.inf, 1.0)}, "thermal_time_s"),
        ({"peak_a": (0.5, 2.0)}, r"peak_a\[0\] is 0.5; choose between continuous_a = 1.0 and 5"),
        ({"peak_a": (2.0, 6.0)}, r"peak_a\[1\] is 6.0.*10 V make of 0.5 A/V"),
        ({"drive_matrix": ((1.0, 0.0),)}, "drive_matrix has 1 items"),
        ({"drive_matrix": ((1.0,), (0.0, 1.0))}, "2 rows of 2"),
        ({"drive_matrix": ((1.0, 1.0), (1.0, 1.0))}, "must tell the other"),
        ({"reference_position_rad": (0.0, np.nan)}, "must be finite"),
        ({"joint_min_rad": (-1.0, -1.0)}, "joint_max_rad is None; give both"),
        ({"joint_max_rad": (1.0, 1.0)}, "joint_min_rad is None, joint_max_rad is .*give both"),
        (stops((-1.0,), (1.0, 0.0)), r"joint_min_rad is \(-1.0,\); 2 finite angles"),
        (stops((-1.0, -1.0), (1.0, np.inf)), "joint_max_rad is .*2 finite angles"),
        (stops((-1.0, 0.0), (1.0, -1.0)), r"joint_min_rad\[1\] is 0.0, .* the smaller"),
        (stops((0.5, -1.0), (1.0, 0.0)), r"joint_min_rad\[0\] is 0.5, .* 0.4, between"),
        (stops((-1.0, -1.0), (1.0, -0.8)), r"joint_max_rad\[1\] is -0.8; .* -0.7, between"),
        ({"watchdog_s": 0.5}, "watchdog_s is 0.5; choose between 0.003 and 0.1"),
        ({"sample_rate_hz": 5}, "sample_rate_hz is 5; choose between 100 and 10000"),
        ({"velocity_filter_s": -1.0}, "velocity_filter_s"),
        ({"implausible_rad_s": 0.0}, "implausible_rad_s"),
        ({"torque_ramp_s": np.nan}, "torque_ramp_s"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DeviceConfigurationError, match=message):
        settings_of(fake.Robot(), **changes)


# The plant that the fakes share


def test_without_further_ado_the_fake_drives_its_joints_of_the_shared_plant(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "plant"
    path.write_bytes(bytes(4096))
    with open(path, "r+b") as file, mmap.mmap(file.fileno(), 4096) as plant:
        angles = np.frombuffer(plant, np.float64, 16, 32)
        torques = np.frombuffer(plant, np.float64, 16, 512)
        stamps = np.frombuffer(plant, np.int64, 16, 640)
        ends = np.frombuffer(plant, np.int64, 16, 768)
        plant[32 : 32 + 32] = np.array([9.0, 0.5, -0.25, 9.0]).tobytes()
        monkeypatch.setenv("FARHAND_FAKE_PLANT", str(path))
        monkeypatch.setenv("FARHAND_FAKE_QUANSER_FIRST", "1")
        assert fake.HIL("q8_usb", "0")
        clock = fake.ManualTime()
        plant_of_default = fake._boards["q8_usb", "0"].plant
        fake.connect(fake.Board(plant=plant_of_default, now_ns=clock))
        device = QuanserDevice(settings_of(fake.Robot(), zero_at_open=False), clock)
        device.open()
        try:
            state = device.read()
            np.testing.assert_allclose(
                state.position_rad, (0.4 + 0.5, -0.7 - 0.5 - 0.25), rtol=0, atol=1e-3
            )
            assert not ends.any()
            device.enable()
            device.write(TORQUE)
            pushed = torques.copy()
            # The watchdog is where the motors are: it needs nobody in this process.
            np.testing.assert_array_equal(ends[:4], [0, *[clock.ns + 20_000_000] * 2, 0])
        finally:
            device.close()
        np.testing.assert_allclose(
            pushed[:4], [0.0, *np.array([[1.0, -1.0], [0.0, 1.0]]) @ TORQUE, 0.0], atol=1e-12
        )
        assert not torques.any()
        assert (stamps[1:3] > 0).all()
        assert not stamps[3:].any()
        assert angles[1] == 0.5
        del angles, torques, stamps, ends  # views into the map, which cannot be closed under them
