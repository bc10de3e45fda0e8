"""Commissioning finds the signs of any wiring, with little current and motion, and always ends."""

import itertools
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from farhand import commission
from farhand.__main__ import app
from hardware.interface import DeviceConfigurationError, DeviceError
from hardware.quanser_commissioning import Commissioning, JointSigns, Probe, toml_snippet
from site_runtime.session_edit import edited
from tests.fakes import quanser_hardware as fake
from tests.fakes.quanser_bench import QuanserBench

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"


@pytest.fixture(autouse=True)
def _no_board_is_left() -> Iterator[None]:
    yield
    fake.disconnect_all()


@dataclass
class Person:
    """Who turns joints when asked, and may press the button after some time."""

    bench: QuanserBench
    torque_nm: float = 0.0
    joint: int = 0
    button_at_ns: float = np.inf
    pauses: int = 0
    interrupt_at: float = np.inf
    seen_nm: list[float] = field(default_factory=list)

    def should_stop(self) -> bool:
        return self.bench.time.ns >= self.button_at_ns

    def pause(self, seconds: float) -> None:
        self.pauses += 1
        if self.pauses >= self.interrupt_at:
            raise KeyboardInterrupt
        self.bench.plant.hand_nm[self.joint] = self.torque_nm
        self.bench.board.pass_time(seconds)
        self.seen_nm.append(max(map(abs, self.bench.board.torque_nm())))


def commissioning(bench: QuanserBench, person: Person, **probe: float) -> Commissioning:
    return Commissioning(
        bench.settings, Probe(**probe), person.should_stop, bench.time, person.pause
    )


def is_off(bench: QuanserBench) -> bool:
    return (
        bench.board.current_a() == [0.0, 0.0]
        and not any(bench.board.amplifiers_on())
        and not bench.board.watchdog_runs()
        and bench.board.owner is None
    )


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=4)))
def test_it_finds_every_wiring_whatever_the_session_says(signs: tuple[int, ...]) -> None:
    robot = fake.Robot(encoder_signs=signs[:2], motor_signs=signs[2:])
    bench = QuanserBench(robot, encoder_signs=(1, 1), motor_signs=(1, 1))
    person = Person(bench)
    found = []
    with commissioning(bench, person) as commission:
        encoders = []
        for joint in range(2):
            commission.rest()
            person.joint, person.torque_nm = joint, 0.1
            encoders.append(commission.encoder_sign(joint))
            person.torque_nm = 0.0
        for joint, sign in enumerate(encoders):
            found.append(commission.signs(joint, sign))
    assert tuple(one.encoder_sign for one in found) == robot.encoder_signs
    assert tuple(one.motor_sign for one in found) == robot.motor_signs
    assert is_off(bench)
    for joint, one in enumerate(found):
        assert 0.0 < one.forward_a <= 0.2
        assert -0.2 <= one.backward_a < 0.0
        moved = np.abs(one.forward_rad)
        assert 0.01 <= moved[joint] < 0.1
        assert moved[1 - joint] < 0.01
    assert max(bench.board.largest_current_a) <= 0.2
    lines = tomllib.loads(toml_snippet(tuple(found)))
    assert lines == {
        "encoder_signs": list(robot.encoder_signs),
        "motor_signs": list(robot.motor_signs),
    }


def test_amplifiers_are_off_while_a_hand_is_on_the_arm() -> None:
    bench = QuanserBench()
    person = Person(bench, torque_nm=-0.1, joint=1)
    with commissioning(bench, person) as commission:
        assert commission.encoder_sign(1) == -bench.robot.encoder_signs[1]
        assert "amplifiers on" not in bench.board.calls
    assert is_off(bench)


def test_a_hand_that_does_not_come_ends_it() -> None:
    bench = QuanserBench()
    with (
        pytest.raises(DeviceError, match="joint 2 was not turned within 1 s"),
        commissioning(bench, Person(bench), hand_timeout_s=1.0) as commission,
    ):
        commission.encoder_sign(1)
    assert is_off(bench)


def test_an_arm_that_does_not_move_ends_it() -> None:
    bench = QuanserBench()
    bench.plant.locked = [True, False]
    with (
        pytest.raises(DeviceError, match=r"joint 1 did not move under 0.2 A .* within 0.4 s"),
        commissioning(bench, Person(bench), ramp_s=0.2) as commission,
    ):
        commission.signs(0, 1)
    assert is_off(bench)
    assert bench.board.largest_current_a == pytest.approx([0.2, 0.0])


def test_motion_beyond_the_limit_ends_it_at_once() -> None:
    bench = QuanserBench()
    person = Person(bench)
    bench.plant.locked = [True, False]
    with commissioning(bench, person, rest_timeout_s=1.0) as commission:

        def shove(seconds: float) -> None:
            if any(bench.board.current_a()):
                person.joint, person.torque_nm = 1, 0.5  # another joint than the one probed
            person.pause(seconds)

        commission._pause = shove
        with pytest.raises(DeviceError, match=r"beyond 0\.1 rad: ended"):
            commission.signs(0, 1)
        assert bench.board.current_a() == [0.0, 0.0]
        assert not any(bench.board.amplifiers_on())
    assert is_off(bench)


def test_an_arm_that_something_else_pushes_is_not_judged() -> None:
    bench = QuanserBench()
    person = Person(bench)
    with commissioning(bench, person) as commission:

        def pull(seconds: float) -> None:
            person.torque_nm = 0.3 if any(bench.board.amplifiers_on()) else 0.0
            person.pause(seconds)

        commission._pause = pull
        with pytest.raises(DeviceError, match="moved the same way"):
            commission.signs(0, 1)
    assert is_off(bench)


def test_an_arm_that_does_not_rest_is_not_probed() -> None:
    bench = QuanserBench()
    person = Person(bench, torque_nm=0.05)
    with (
        pytest.raises(DeviceError, match="did not come to rest"),
        commissioning(bench, person, rest_timeout_s=1.0) as commission,
    ):
        commission.signs(0, 1)
    assert "amplifiers on" not in bench.board.calls
    assert is_off(bench)


def test_the_button_ends_it_at_once() -> None:
    bench = QuanserBench()
    person = Person(bench)
    bench.plant.locked = [True, True]
    with commissioning(bench, person) as commission:
        person.button_at_ns = bench.time.ns + 1_000_000_000
        with pytest.raises(DeviceError, match="ended by hand"):
            commission.signs(0, 1)
        assert bench.time.ns == person.button_at_ns
        assert bench.board.current_a() == [0.0, 0.0]
    assert max(person.seen_nm) > 0.0
    assert is_off(bench)


def test_control_c_ends_it_at_once() -> None:
    bench = QuanserBench()
    person = Person(bench, interrupt_at=1000)
    bench.plant.locked = [True, True]
    with pytest.raises(KeyboardInterrupt), commissioning(bench, person) as commission:
        commission.signs(0, 1)
    assert max(person.seen_nm) > 0.0
    assert is_off(bench)


def test_a_second_control_c_does_not_leave_motors_on(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = QuanserBench()
    person = Person(bench, interrupt_at=1000)
    bench.plant.locked = [True, True]
    examined = commissioning(bench, person)
    make_safe, calls = examined._board.make_safe, []

    def interrupted() -> None:
        calls.append(bench.board.current_a())
        if len(calls) == 1:
            raise KeyboardInterrupt
        make_safe()

    monkeypatch.setattr(examined._board, "make_safe", interrupted)
    with pytest.raises(KeyboardInterrupt), examined:
        examined.signs(0, 1)
    assert any(calls[1])  # still flowing when it was tried again
    assert is_off(bench)


def unplug(bench: QuanserBench) -> None:
    bench.board.unplug()


def expire(bench: QuanserBench) -> None:
    bench.board.expire_watchdog()


@pytest.mark.parametrize(
    ("fault", "message"), [(unplug, "no longer answers"), (expire, "watchdog expired")]
)
def test_a_fault_of_the_board_ends_it(fault: Callable[[QuanserBench], None], message: str) -> None:
    bench = QuanserBench()
    person = Person(bench)
    bench.plant.locked = [True, True]
    with commissioning(bench, person) as commission:

        def fail(seconds: float) -> None:
            person.pause(seconds)
            if any(bench.board.current_a()):
                fault(bench)

        commission._pause = fail
        with pytest.raises(DeviceError, match=message):
            commission.signs(0, 1)
    bench.board.pass_time(0.1)
    assert bench.board.current_a() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("probe", "message"),
    [
        ({"current_a": 0.9}, r"0.9 A is above continuous_a\[1\] = 0.8"),
        ({"current_a": -0.1}, "current_a is -0.1; must be positive"),
        ({"seen_rad": 0.08}, "at most half of end_rad"),
    ],
)
def test_probes_that_ask_for_too_much_are_refused(probe: dict[str, float], message: str) -> None:
    bench = QuanserBench()
    with pytest.raises(DeviceConfigurationError, match=message):
        commissioning(bench, Person(bench), **probe)


# The command


def session(tmp_path: Path, bench: QuanserBench, **changes: Any) -> Path:
    keys = {name: getattr(bench.settings, name) for name in type(bench.settings).__slots__}
    device = {name: value for name, value in keys.items() if value is not None} | changes
    path = tmp_path / "bench.toml"
    text = edited(
        DEMO.read_text(encoding="utf-8"),
        {
            "local.device": device,
            "local.limits.torque_nm": [1.0, 1.0],
            "local.limits.velocity_rad_s": [5.0, 5.0],
        },
    )
    path.write_text(text, encoding="utf-8")
    return path


def test_the_command_prints_what_to_paste(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = QuanserBench(encoder_signs=(1, 1), motor_signs=(1, 1))
    person = Person(bench)
    turns = iter(((0, 0.1), (1, 0.1)))

    def turn(self: Commissioning, joint: int) -> int:
        person.joint, person.torque_nm = next(turns)
        sign = encoder_sign(self, joint)
        person.torque_nm = 0.0
        return sign

    encoder_sign = Commissioning.encoder_sign
    monkeypatch.setattr(Commissioning, "encoder_sign", turn)
    monkeypatch.setattr(commission.time, "monotonic_ns", bench.time)
    monkeypatch.setattr(commission.time, "sleep", person.pause)
    path = session(tmp_path, bench)
    arguments = ["commission-quanser", str(path), "--site", "local"]
    result = CliRunner().invoke(app, arguments, input="y\n")
    assert result.exit_code == 0, result.output
    assert "encoder_signs = [1, -1]\nmotor_signs = [-1, 1]" in result.output
    assert is_off(bench)


def test_the_command_moves_nothing_without_a_yes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = QuanserBench()
    monkeypatch.setattr(Commissioning, "encoder_sign", lambda self, joint: 1)
    arguments = ["commission-quanser", str(session(tmp_path, bench)), "--site", "local"]
    result = CliRunner().invoke(app, arguments, input="n\n")
    assert result.exit_code == 1
    assert "amplifiers on" not in bench.board.calls
    assert is_off(bench)


def test_the_command_explains_a_site_without_such_a_robot_and_a_board_that_is_not_there(
    tmp_path: Path,
) -> None:
    result = CliRunner().invoke(app, ["commission-quanser", str(DEMO), "--site", "remote"])
    assert result.exit_code == 2
    assert 'driver = "simulated"' in result.output
    path = session(tmp_path, QuanserBench(), board_type="q4")
    result = CliRunner().invoke(app, ["commission-quanser", str(path), "--site", "local"])
    assert result.exit_code == 2
    assert "could not be found" in result.output


def test_the_robot_may_be_a_part_of_the_sites_device() -> None:
    bench = QuanserBench()

    @dataclass(frozen=True)
    class Pair:
        proximal: object
        driver: str = "pair"

    assert commission.quanser_settings(Pair(bench.settings), "remote") is bench.settings
    other = replace(bench.settings, board_id="1")
    assert commission.quanser_settings(other, "remote") is other


def test_signs_of_three_joints_make_two_lines() -> None:
    found = tuple(JointSigns(e, m, 0.1, -0.1, (0.0,)) for e, m in ((1, -1), (-1, -1), (1, 1)))
    assert toml_snippet(found) == "encoder_signs = [1, -1, 1]\nmotor_signs = [-1, -1, 1]"
