import json
import pickle
import tomllib
from dataclasses import FrozenInstanceError
from math import inf
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.delay import ConstantDelay, SinusoidDelay, TraceDelay
from hardware.jr3 import Jr3Settings
from hardware.simulated import SimulatedSettings
from site_runtime.keys import SiteId
from site_runtime.session import (
    NoOperator,
    SessionError,
    SessionFileError,
    StiffnessCoupling,
    load_session,
    parse_session,
)

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
MINIMAL = """
format = 1
name = "minimal"
[task]
dimension = 2
[coupling]
law = "stiffness"
stiffness_n_per_m = [200, 200.0]
force_ceiling_n = [10.0, 10.0]
[local]
robot = { kind = "planar", lengths_m = [0.38, 0.38], masses_kg = [0.3, 0.3] }
damping = { joint_nm_s = [0.1, 0.1], task_n_s_per_m = [40.0, 40.0] }
device = { driver = "simulated", initial_position_rad = [0.0, 1.0] }
[remote]
robot = { kind = "planar", lengths_m = [0.38, 0.38, 0.38], masses_kg = [0.3, 0.3, 0.3] }
damping = { joint_nm_s = [0.1, 0.1, 0.1], task_n_s_per_m = [40.0, 40.0] }
device = { driver = "simulated", initial_position_rad = [0.0, 1.0, 1.0] }
"""
URDF_REMOTE = (
    'robot = { kind = "planar", lengths_m = [0.38, 0.38, 0.38], masses_kg = [0.3, 0.3, 0.3] }'
)


def parse(text):
    return parse_session(text, EXPERIMENTS / "of_a_test.toml")


def problems_of(text):
    with pytest.raises(SessionFileError) as caught:
        parse(text)
    assert str(caught.value).count("\n") == len(caught.value.problems)
    return {problem.key: problem for problem in caught.value.problems}


def only_problem(text):
    found = problems_of(text)
    assert len(found) == 1, found
    return next(iter(found.values()))


def replaced(old, new, text=MINIMAL):
    assert old in text
    return text.replace(old, new, 1)


# What a good file gives


def test_what_is_left_out_has_its_safe_default():
    session = parse(MINIMAL)
    assert session.loop.rate_hz == 1000
    assert session.real_time.mode == "try"
    assert session.channel.injection == "off"
    assert session.channel.local_to_remote.delay == ConstantDelay(0.0)
    assert session.engagement.ramp_s == 2.0
    assert session.local.operator == NoOperator("none")
    assert session.remote.sub_tasks == ()
    assert session.remote.null_space.rate_limit_rad_s == 1.0
    assert session.network.local_connect == session.network.remote_listen


def test_values_are_typed_and_frozen():
    session = parse(MINIMAL)
    assert session.coupling == StiffnessCoupling("stiffness", (200.0, 200.0), (10.0, 10.0))
    assert isinstance(session.coupling, StiffnessCoupling)
    assert all(type(value) is float for value in session.coupling.stiffness_n_per_m)
    assert session.local.device == SimulatedSettings((0.0, 1.0))
    assert session.site(SiteId.REMOTE) is session.remote
    assert session.site(SiteId.LOCAL) is session.local
    with pytest.raises(FrozenInstanceError):
        session.name = "other"
    assert session.text == MINIMAL


def test_periods_are_whole_ticks():
    session = parse(MINIMAL + "[loop]\nrate_hz = 500\n[channel]\nsend_rate_hz = 125\n")
    assert (session.period_ns, session.send_period_ns) == (2_000_000, 8_000_000)
    assert parse(MINIMAL).send_period_ns == 1_000_000


def test_every_kind_of_operator_and_sub_task():
    session = parse(
        MINIMAL
        + """
[[local.operator.pulses]]
axis = "x"
force_n = 1.0
start_s = 5
end_s = 15
[local.operator]
kind = "pulses"
[remote.null_space]
rate_limit_rad_s = inf
[[remote.obstacles]]
name = "post"
center_m = [0.1, 0.2]
collision_radius_m = 0.1
safe_radius_m = 0.2
[[remote.sub_tasks]]
kind = "linear_singularity"
gain = 0.01
direction = [1, -2, 1]
[[remote.sub_tasks]]
kind = "manipulability"
gain = 1
[[remote.sub_tasks]]
kind = "paper_obstacle"
gain = 1
[[remote.sub_tasks]]
kind = "obstacle"
gain = 1
weight = 0
[[remote.sub_tasks]]
kind = "joint_limits"
gain = 1
lower_rad = [-1, -1, -1]
upper_rad = [1, 1, 1]
"""
    )
    kinds = [task.kind for task in session.remote.sub_tasks]
    assert kinds == [
        *("linear_singularity", "manipulability", "paper_obstacle", "obstacle", "joint_limits")
    ]
    assert session.local.operator.pulses[0].end_s == 15.0
    assert session.remote.null_space.rate_limit_rad_s == inf


# The digest


def test_the_digest_sees_values_not_their_writing():
    first = parse(MINIMAL)
    spaced = MINIMAL.replace("= [", "=   [  # a comment\n").replace("40.0", "4.0e1")
    spelled_out = MINIMAL + "[loop]\nrate_hz = 1000\n"
    assert parse(spaced).digest == first.digest
    assert parse(spelled_out).digest == first.digest
    assert 0 < first.digest < 2**64


def test_addresses_and_real_time_belong_to_a_machine():
    own = MINIMAL + '[network]\nlocal_connect = "tcp/b.example:7447"\n[real_time]\nmode = "off"\n'
    assert parse(own).digest == parse(MINIMAL).digest


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[200, ", "[200.0000001, "),
        ("0.1, 0.1, 0.1", "0.1, 0.1, 0.11"),
        ("[0.0, 1.0]", "[0.0, 1.0000001]"),
        ("dimension = 2", "dimension = 2\n[engagement]\nramp_s = 1.0"),
        ("format = 1", "format = 1\nseed = 5"),
        ('"minimal"', '"minimal2"'),
    ],
)
def test_the_digest_sees_every_other_value(old, new):
    assert parse(replaced(old, new)).digest != parse(MINIMAL).digest


def test_a_trace_counts_by_its_content_not_its_place(tmp_path):
    def session(folder, rows):
        folder.mkdir(exist_ok=True)
        (folder / "trace.csv").write_text(rows, encoding="utf-8")
        text = MINIMAL + (
            '[channel.local_to_remote]\ndelay = { model = "trace", path = "trace.csv" }\n'
        )
        return parse_session(text, folder / "session.toml")

    here = session(tmp_path / "a", "time_s,delay_s\n0,0.1\n1,0.2\n")
    there = session(tmp_path / "b", "time_s,delay_s\n0,0.1\n1,0.2\n")
    other = session(tmp_path / "c", "time_s,delay_s\n0,0.1\n1,0.3\n")
    assert isinstance(here.channel.local_to_remote.delay, TraceDelay)
    assert here.channel.local_to_remote.delay.path != there.channel.local_to_remote.delay.path
    assert here.digest == there.digest != other.digest


def test_a_relative_path_is_relative_to_the_file_not_to_the_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session = load_session(EXPERIMENTS / "seven_dof.toml")
    assert Path(session.remote.robot.path) == EXPERIMENTS / "seven_dof_arm.urdf"


# Messages: the key, its value, what is allowed, the nearest key


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ("dimension = 2", "dimensoin = 2", "task.dimensoin", ["nearest is dimension"]),
        ("[task]", "[tusk]", "tusk", ["nearest is task"]),
        ("joint_nm_s = [0.1, 0.1]", "joint_n_m_s = [0.1, 0.1]", None, ["joint_nm_s"]),
        ("stiffness_n_per_m", "stiffness_n_per_mm", None, ["stiffness in N/m: stiffness_n_per_m"]),
        ("lengths_m", "length_cm", None, ["length_cm is not a key", "lengths_m"]),
        ("lengths_m", "lengths_cm", None, ["lengths in metres: lengths_m"]),
        ("initial_position_rad", "initial_position_deg", None, ["angles in radians"]),
        ("[200, ", "[-200, ", "coupling.stiffness_n_per_m[0]", ["= -200", "greater than 0"]),
        ("[200, ", '["200", ', "coupling.stiffness_n_per_m[0]", ['= "200"', "a number"]),
        ("[200, ", "[true, ", "coupling.stiffness_n_per_m[0]", ["= true", "a number"]),
        ("[200, ", "[nan, ", "coupling.stiffness_n_per_m[0]", ["= NaN", "a number"]),
        ("[200, ", "[inf, ", "coupling.stiffness_n_per_m[0]", ["= Infinity", "a number"]),
        ("dimension = 2", "dimension = 4", "task.dimension", ["= 4", "one of 2, 3"]),
        ("dimension = 2", "", "task.dimension", ["is missing", "one of 2, 3"]),
        ("format = 1", "format = 2", "format", ["= 2", "must be 1"]),
        ('"minimal"', '"a/b"', "name", ['"a/b"', "letters, digits"]),
        ('"stiffness"', '"stifness"', "coupling.law", ['nearest is "stiffness"', '"paper"']),
        ('law = "stiffness"', "", "coupling.law", ["is missing", '"stiffness", "paper"']),
        ('"simulated"', '"simulatd"', "local.device.driver", ['nearest is "simulated"']),
        ('driver = "simulated", ', "", "local.device.driver", ["is missing", '"simulated"']),
        ("initial_position_rad", "brakes = 1, initial_position_rad", None, ["true or false"]),
        ("initial_position_rad", "step_s = 0.0, initial_position_rad", "local.device", ["step_s"]),
        ('kind = "planar"', 'kind = "urfd"', "local.robot.kind", ['"urdf"']),
        ("[0.38, 0.38]", "[0.38, -0.38]", "local.robot", ["-0.38", "positive"]),
    ],
)
def test_one_mistake_is_one_problem_that_says_what_to_do(old, new, key, words):
    problem = only_problem(replaced(old, new))
    assert key in (None, problem.key)
    for word in words:
        assert word in str(problem)


@pytest.mark.parametrize(
    ("added", "key", "words"),
    [
        ("[channel]\nsend_rate_hz = 300", "channel.send_rate_hz", ["= 300", "divide", "1000"]),
        ("[channel]\nsend_rate_hz = 2000", "channel.send_rate_hz", ["2000", "1000"]),
        ("[channel]\nsend_rate_hz = 10", "engagement.hold_after_s", ["0.1", "three times"]),
        ("[engagement]\nhold_after_s = 0.001", "engagement.hold_after_s", ["0.001"]),
        ("[loop]\nrate_hz = 5", "loop.rate_hz", ["= 5", "at least 10 and at most 10000"]),
        ("[loop]\nrate_khz = 1", "loop.rate_khz", ["rates in hertz: rate_hz"]),
        ("[real_time]\npriority = 100", "real_time.priority", ["at most 99"]),
        ('[network]\nlocal_listen = "7447"', "network.local_listen", ["Zenoh endpoint"]),
        ("[network]\nlease_ms = 500", "network.lease_ms", ["times in seconds: lease_s"]),
        (
            "[channel.local_to_remote]\ndelay = 3",
            "channel.local_to_remote.delay",
            ["= 3", '"sinusoid"'],
        ),
        (
            "[channel.local_to_remote]\ndelay = { delay_ms = 1 }",
            "channel.local_to_remote.delay.model",
            ["is missing"],
        ),
        (
            '[channel.local_to_remote]\ndelay = { model = "constant", delay_ms = 1 }',
            "channel.local_to_remote.delay.delay_ms",
            ["times in seconds: delay_s"],
        ),
        (
            "[channel.local_to_remote]\n"
            'delay = { model = "sinusoid", mean_s = 0.1, amplitude_s = 0.2 }',
            "channel.local_to_remote.delay",
            ["amplitude_s = 0.2", "0.1"],
        ),
        (
            '[channel.local_to_remote]\ndelay = { model = "trace", path = "nowhere.csv" }',
            "channel.local_to_remote.delay",
            ["nowhere.csv"],
        ),
        (
            '[[remote.sub_tasks]]\nkind = "obstacle"\ngain = 1',
            "remote.sub_tasks[0].kind",
            ["[[remote.obstacles]]"],
        ),
        (
            '[[remote.sub_tasks]]\nkind = "joint_limits"\ngain = 1',
            "remote.sub_tasks[0].lower_rad",
            ["is missing"],
        ),
        (
            '[[remote.sub_tasks]]\nkind = "joint_limits"\ngain = 1\nlower_rad = [1, 1, 1]\n'
            "upper_rad = [2, 0.5, 2]",
            "remote.sub_tasks[0].upper_rad[1]",
            ["0.5", "1.0"],
        ),
        (
            '[[remote.sub_tasks]]\nkind = "linear_singularity"\ngain = 1\ndirection = [1, 2]',
            "remote.sub_tasks[0].direction",
            ["2 numbers", "3 are needed", "one per joint"],
        ),
        (
            '[[remote.sub_tasks]]\nkind = "linear_singularity"\ngain = 1\ndirection = [0, 0, 0]',
            "remote.sub_tasks[0].direction",
            ["not be zero"],
        ),
        (
            '[[remote.obstacles]]\nname = "a"\ncenter_m = [0, 0]\ncollision_radius_m = 0.2\n'
            "safe_radius_m = 0.2",
            "remote.obstacles[0].safe_radius_m",
            ["greater than collision_radius_m = 0.2"],
        ),
        (
            '[remote.environment]\nwalls = [{ name = "w", point_m = [0, 0], normal = [0, 0], '
            "stiffness_n_per_m = 1 }]",
            "remote.environment.walls[0].normal",
            ["not be zero"],
        ),
        (
            "[remote.limits]\nworkspace_min_m = [0, 0]",
            "remote.limits.workspace_max_m",
            ["is missing"],
        ),
        (
            "[remote.limits]\nworkspace_min_m = [0, 0]\nworkspace_max_m = [1, 0]",
            "remote.limits.workspace_max_m[1]",
            ["greater than workspace_min_m = 0"],
        ),
        ("[remote.limits]\ntorque_nm = [1]", "remote.limits.torque_nm", ["1 number", "3"]),
        (
            '[local.operator]\nkind = "constant"\nforce_n = [1, 2, 3]',
            "local.operator.force_n",
            ["3 numbers", "2 are needed"],
        ),
        (
            '[local.operator]\nkind = "pulses"\n'
            'pulses = [{ axis = "z", force_n = 1, start_s = 1, end_s = 2 }]',
            "local.operator.pulses[0].axis",
            ['"z"', "x, y"],
        ),
        (
            '[local.operator]\nkind = "pulses"\n'
            'pulses = [{ axis = "x", force_n = 1, start_s = 2, end_s = 2 }]',
            "local.operator.pulses[0].end_s",
            ["after start_s = 2"],
        ),
        (
            "[remote.null_space]\nrate_limit_rad_s = 0",
            "remote.null_space.rate_limit_rad_s",
            ["inf"],
        ),
        (
            "[remote.null_space]\nrate_limit_rad_s = nan",
            "remote.null_space.rate_limit_rad_s",
            ["NaN"],
        ),
    ],
)
def test_what_contradicts_is_said(added, key, words):
    problem = only_problem(MINIMAL + added)
    assert problem.key == key
    for word in words:
        assert word in str(problem)


def test_a_sub_task_needs_a_redundant_robot():
    text = MINIMAL.replace("0.38, 0.38, 0.38", "0.38, 0.38").replace("0.3, 0.3, 0.3", "0.3, 0.3")
    text = text.replace("0.1, 0.1, 0.1", "0.1, 0.1").replace("0.0, 1.0, 1.0", "0.0, 1.0")
    assert parse(text).remote.sub_tasks == ()
    problem = only_problem(text + '[[remote.sub_tasks]]\nkind = "manipulability"\ngain = 1\n')
    assert problem.key == "remote.sub_tasks"
    assert "redundant" in problem.reason


def test_robots_and_task_must_agree():
    found = problems_of(replaced("dimension = 2", "dimension = 3"))
    assert {"local.robot", "remote.robot", "coupling.stiffness_n_per_m"} <= set(found)


def test_names_must_differ():
    post = '[[remote.obstacles]]\nname = "a"\ncenter_m = [0, 0]\n'
    post += "collision_radius_m = 0.1\nsafe_radius_m = 0.2\n"
    problem = only_problem(MINIMAL + 2 * post)
    assert problem.key == "remote.obstacles[1].name"


def test_a_real_robot_needs_its_limits(monkeypatch):
    from dataclasses import dataclass

    from hardware.registry import DriverEntry
    from site_runtime import session_settings

    @dataclass(frozen=True, slots=True)
    class Bare:
        driver: str

    monkeypatch.setattr(session_settings, "drivers", lambda: ("bare", "simulated"))
    entries = {
        "bare": DriverEntry(Bare, lambda *_: None),
        "simulated": DriverEntry(SimulatedSettings, lambda *_: None),
    }
    monkeypatch.setattr(session_settings, "driver", entries.__getitem__)
    text = replaced('"simulated", initial_position_rad = [0.0, 1.0, 1.0]', '"bare"')
    assert set(problems_of(text)) == {"remote.limits.torque_nm", "remote.limits.velocity_rad_s"}
    limits = "[remote.limits]\ntorque_nm = [1, 1, 1]\nvelocity_rad_s = [1, 1, 1]\n"
    assert parse(text + limits).remote.device == Bare("bare")


JR3 = """
[local.force_sensor]
driver = "jr3"
interface = "socketcan"
channel = "can0"
node = 1
mounting = "end_effector"
rotation = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
"""


def test_a_force_sensor_is_an_option_of_either_site():
    session = parse(MINIMAL + JR3)
    assert session.remote.force_sensor is None
    assert session.local.force_sensor == Jr3Settings(
        interface="socketcan",
        channel="can0",
        node=1,
        mounting="end_effector",
        rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    )
    assert parse(MINIMAL + JR3.replace("local", "remote")).remote.force_sensor.node == 1
    assert session.digest != parse(MINIMAL).digest


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ('"jr3"', '"jr4"', "driver", ['nearest is "jr3"']),
        ('"jr3"', '"simulated"', "driver", ['must be one of "jr3"']),
        ('driver = "jr3"\n', "", "driver", ["is missing", '"jr3"']),
        ("node = 1", "node = 1.5", "node", ["= 1.5", "whole number"]),
        ("node = 1\n", "", "node", ["is missing"]),
        ("node = 1", "node = 1\ncutoff_khz = 1", "cutoff_khz", ["rates in hertz: cutoff_hz"]),
        ('"end_effector"', '"tool"', "mounting", ['one of "base", "end_effector"']),
        ("[0, 0, 1]]", '[0, 0, "1"]]', "rotation[2][2]", ['= "1"']),
        ("[0, 0, 1]]", "[0, 0]]", "rotation[2][2]", ["is missing"]),
        ("[0, 0, 1]]", "[0, 0, 2]]", "", ["rotation is", "unit vectors"]),
        ("node = 1", "node = 128", "", ["node is 128", "1 and 127"]),
    ],
)
def test_a_force_sensor_s_settings_are_checked_like_a_device_s(old, new, key, words):
    problem = only_problem(MINIMAL + replaced(old, new, JR3))
    assert problem.key == f"local.force_sensor.{key}".rstrip(".")
    for word in words:
        assert word in str(problem)


def test_a_force_sensor_is_a_table():
    text = replaced("[remote]\n", '[remote]\nforce_sensor = "jr3"\n')
    assert "driver = a driver's name" in only_problem(text).reason


def test_every_problem_is_listed_with_its_line():
    text = replaced("dimension = 2", "dimension = 7").replace("format = 1", "format = 0")
    text = replaced("[0.0, 1.0]", "[0.0, 'x']", text) + "[loop]\n# a comment\nrate = 1\n"
    found = problems_of(text)
    assert {key: problem.line for key, problem in found.items()} == {
        "format": 2,
        "task.dimension": 5,
        "local.device.initial_position_rad[1]": 13,
        "loop.rate": 20,
    }
    assert "line 20: loop.rate = 1" in str(found["loop.rate"])


def test_lines_of_arrays_of_tables():
    post = '[[remote.obstacles]]\nname = "{0}"\ncenter_m = [0, 0]\n'
    post += "collision_radius_m = 0.1\nsafe_radius_m = {1}\n"
    text = MINIMAL + post.format("a", 0.2) + post.format("b", 0.05)
    assert only_problem(text).line == 27


@pytest.mark.parametrize(
    "content", [b"\xff\xfe", b"format = ", b"a" * 10 + b"\x00", b"[" * 5000, b"x=" + b"[" * 5000]
)
def test_what_is_not_toml(tmp_path, content):
    path = tmp_path / "session.toml"
    path.write_bytes(content)
    with pytest.raises(SessionFileError, match=r"session\.toml: 1 problem"):
        load_session(path)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(SessionError, match="No such file"):
        load_session(tmp_path / "none.toml")


@pytest.mark.parametrize("number", ["0x" + "f" * 5000, "9" * 5000, "1e400", "2024-01-01"])
def test_numbers_beyond_all_bounds(number):
    problems_of(replaced("[200, ", f"[{number}, "))


def test_a_urdf_must_be_usable():
    path = (EXPERIMENTS / "seven_dof_arm.urdf").name
    robot = f'robot = {{ kind = "urdf", path = "{path}", end_effector_frame = "tol_tip" }}'
    problem = only_problem(replaced(URDF_REMOTE, robot))
    assert (problem.key, "tool_tip" in problem.reason) == ("remote.robot", True)
    missing = robot.replace(path, "nowhere.urdf")
    assert "nowhere.urdf" in only_problem(replaced(URDF_REMOTE, missing)).reason


# Whatever is written, a session or a SessionFileError


def to_toml(value, key=""):
    """Inline TOML of nested dicts and lists."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {to_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(to_toml, value)) + "]"
    if isinstance(value, float):
        return "nan" if value != value else repr(value)  # inf and -inf are TOML
    return json.dumps(value)


def places(value, path=()):
    yield path
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*path, key))


FILES = [
    tomllib.loads(path.read_text(encoding="utf-8"))
    for path in sorted(EXPERIMENTS.glob("*.toml"))
    if path.stem != "seven_dof"
] + [tomllib.loads(MINIMAL)]
scalars = st.one_of(
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(st.characters(codec="ascii", categories=("L", "N", "P", "Zs")), max_size=8),
    st.sampled_from(["planar", "urdf", "simulated", "obstacle", "trace", "paper", "none", "x"]),
)
values = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                ["kind", "model", "law", "driver", "path", "gain", "delay_s", "", "a b"]
            ),
            inner,
            max_size=4,
        )
    ),
    max_leaves=6,
)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_a_mutated_file_gives_a_session_or_a_session_file_error(data):
    document = json.loads(json.dumps(data.draw(st.sampled_from(FILES))))
    for _ in range(data.draw(st.integers(1, 3))):
        where = data.draw(st.sampled_from([place for place in places(document) if place] or [None]))
        if where is None:
            break
        holder = document
        for key in where[:-1]:
            holder = holder[key]
        action = data.draw(st.sampled_from(["replace", "delete", "rename"]))
        if action == "replace" or isinstance(holder, list):
            holder[where[-1]] = data.draw(values)
        else:
            kept = holder.pop(where[-1])
            if action == "rename":
                holder[data.draw(st.text("abmns_.é ", max_size=6))] = kept
    text = "\n".join(f"{json.dumps(key)} = {to_toml(value)}" for key, value in document.items())
    try:
        session = parse(text)
    except SessionFileError as error:
        found = error.problems
    else:
        found = None
        assert parse("# again\n" + text).digest == session.digest
    assert found is None or (found and all(problem.key and problem.reason for problem in found))


def test_the_sinusoid_of_the_paper_is_read_exactly():
    session = load_session(EXPERIMENTS / "paper_free.toml")
    assert session.channel.remote_to_local.delay == SinusoidDelay(0.1, 0.1, 1.0, 0.0)


def test_an_error_comes_back_whole_from_another_process(tmp_path):
    with pytest.raises(SessionFileError) as caught:
        parse_session("format = 2", tmp_path / "session.toml")
    copy = pickle.loads(pickle.dumps(caught.value))  # noqa: S301  our own bytes
    assert str(copy) == str(caught.value)
    assert copy.problems == caught.value.problems
