"""Edited texts mean what tomllib reads of them, and keep what was not to change."""

import copy
import json
import re
import tomllib
from pathlib import Path

import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st

from site_runtime.session import SessionError, parse_session
from site_runtime.session_edit import edited, paths_from

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
FILES = sorted(EXPERIMENTS.glob("*.toml"))
DEMO = (EXPERIMENTS / "demo.toml").read_text(encoding="utf-8")


def parsed(text):
    return parse_session(text, EXPERIMENTS / "of_a_test.toml")


def changed_lines(before, after):
    return sorted(set(before.splitlines()) ^ set(after.splitlines()))


def test_without_changes_the_text_is_the_same():
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        assert edited(text, {}) == text


def test_a_key_of_a_table():
    text = edited(DEMO, {"coupling.stiffness_n_per_m": [150.0, 80.5]})
    assert parsed(text).coupling.stiffness_n_per_m == (150.0, 80.5)
    assert changed_lines(DEMO, text) == [
        "stiffness_n_per_m = [150.0, 80.5]",
        "stiffness_n_per_m = [200.0, 200.0]",
    ]


def test_a_key_of_an_inline_table_keeps_its_neighbours_and_the_comment():
    text = edited(DEMO, {"local.damping.task_n_s_per_m": [12.4, 12.4]})
    assert parsed(text).local.damping.task_n_s_per_m == (12.4, 12.4)
    assert changed_lines(DEMO, text) == [
        "damping = { joint_nm_s = [0.1, 0.1], task_n_s_per_m = [12.4, 12.4] } "
        "# Theorem B: a round trip of 2 D/K = 0.3 s",
        "damping = { joint_nm_s = [0.1, 0.1], task_n_s_per_m = [30.0, 30.0] } "
        "# Theorem B: a round trip of 2 D/K = 0.3 s",
    ]


def test_an_item_of_an_array_of_tables_and_of_a_list_of_inline_tables():
    text = edited(
        DEMO,
        {
            "remote.obstacles[0].center_m": [0.2, 0.3],
            "remote.environment.walls[0].point_m[1]": 0.25,
        },
    )
    remote = parsed(text).remote
    assert remote.obstacles[0].center_m == (0.2, 0.3)
    assert remote.environment.walls[0].point_m == (0.48, 0.25)
    assert len(changed_lines(DEMO, text)) == 4


def test_a_whole_table_is_replaced():
    text = edited(DEMO, {"coupling": {"law": "paper", "omega": [1.0, 2.0], "b": [1.0, 0.5]}})
    assert tomllib.loads(text)["coupling"] == {"law": "paper", "omega": [1.0, 2.0], "b": [1.0, 0.5]}
    assert parsed(text).coupling.omega == (1.0, 2.0)


def test_a_delay_of_another_model_replaces_an_inline_table():
    key = "channel.local_to_remote.delay"
    text = edited(DEMO, {key: {"model": "constant", "delay_s": 0.05}})
    assert parsed(text).channel.local_to_remote.delay.delay_s == 0.05
    assert '\ndelay = {model = "constant", delay_s = 0.05}\n' in text


def test_an_array_of_tables_is_replaced_by_fewer_more_or_none():
    one = edited(DEMO, {"remote.sub_tasks": [{"kind": "manipulability", "gain": 5.0}]})
    assert [task.kind for task in parsed(one).remote.sub_tasks] == ["manipulability"]
    tasks = [{"kind": "manipulability", "gain": 5.0}, {"kind": "obstacle", "gain": 10.0}]
    two = edited(DEMO, {"remote.sub_tasks": tasks})
    assert [task.gain for task in parsed(two).remote.sub_tasks] == [5.0, 10.0]
    assert parsed(edited(DEMO, {"remote.sub_tasks": []})).remote.sub_tasks == ()
    assert parsed(edited(DEMO, {"remote.sub_tasks": None})).remote.sub_tasks == ()


def test_a_missing_table_is_created():
    minimal = edited(DEMO, {"engagement": None, "real_time": None, "local.limits": None})
    assert "engagement" not in tomllib.loads(minimal)
    text = edited(
        minimal,
        {
            "engagement.ramp_s": 3.0,
            "local.limits.torque_nm": [5.0, 5.0],
            "channel.local_to_remote.loss.enter_burst": 0.01,
            "channel.local_to_remote.loss.leave_burst": 0.5,
            "seed": 7,
        },
    )
    session = parsed(text)
    assert session.engagement.ramp_s == 3.0
    assert session.local.limits.torque_nm == (5.0, 5.0)
    assert session.channel.local_to_remote.loss.leave_burst == 0.5
    assert session.seed == 7


def test_a_key_is_removed_and_one_that_is_not_there_is_no_matter():
    text = edited(DEMO, {"channel.injection": None, "remote.limits.workspace_min_m": None})
    assert "injection" not in tomllib.loads(text)["channel"]
    assert "workspace_min_m" not in tomllib.loads(text)["remote"]["limits"]
    assert edited(DEMO, {"remote.nothing.here": None, "seeds": None}) == DEMO


def test_a_table_emptied_stays():
    for text in ("[a.b]\nc = 1\n", "a = {b = {c = 1}}\n", "[a]\n[a.b]\nc = 1\n"):
        assert tomllib.loads(edited(text, {"a.b": None})) == {"a": {}}
        assert tomllib.loads(edited(text, {"a.b.c": None})) == {"a": {"b": {}}}
        assert tomllib.loads(edited(text, {"a": {}})) == {"a": {}}


def test_a_tuple_is_a_list_and_the_types_of_numbers_are_kept():
    text = edited(DEMO, {"seed": 3, "engagement.ramp_s": 2.0, "local.operator.center_m": (0.4, 1)})
    document = tomllib.loads(text)
    assert (document["seed"], type(document["seed"])) == (3, int)
    assert type(document["engagement"]["ramp_s"]) is float
    assert document["local"]["operator"]["center_m"] == [0.4, 1]


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("seed.of", "seed is 1"),
        ("remote.obstacles[0]", "only a table"),
        ("remote.obstacles[1].name", r"remote.obstacles is a list of 1"),
        ("remote.obstacles.name", r"remote.obstacles is a list of 1"),
        ("remote.damping[0]", "remote.damping is a table"),
        ("remote..damping", "is not a key"),
        ("", "is not a key"),
        ("remote.obstacles[-1]", "is not a key"),
    ],
)
def test_a_key_that_cannot_be_set_is_refused(key, reason):
    with pytest.raises(SessionError, match=reason):
        edited(DEMO, {key: 1.0})


def test_a_text_that_is_not_toml_is_refused():
    with pytest.raises(SessionError, match="not TOML"):
        edited("a = ", {"a": 1})


def test_tables_torn_apart_may_be_changed_but_not_grow():
    text = "[local]\na = 1\n[remote]\nb = 1\n[local.device]\nc = 1\n"
    assert edited(text, {"local.device.c": 2, "local.a": 3}) == text.replace(
        "c = 1", "c = 2"
    ).replace("a = 1", "a = 3")
    with pytest.raises(SessionError, match="directly after"):
        edited(text, {"local.new.key": 1})


def test_values_that_come_out_otherwise_are_refused(monkeypatch):
    # Stands for a layout that the editor gets wrong.
    monkeypatch.setattr(tomlkit, "parse", lambda text: tomlkit.loads(text.replace("true", "false")))
    with pytest.raises(SessionError, match="layout"):
        edited("a = true\nb = 1\n", {"b": 2})


def test_a_file_may_move_to_another_folder(tmp_path):
    trace = tmp_path / "traces" / "wifi.csv"
    trace.parent.mkdir()
    trace.write_text("time_s,delay_s\n0.0,0.02\n")
    text = (EXPERIMENTS / "seven_dof.toml").read_text(encoding="utf-8")
    key = "channel.local_to_remote.delay"
    changes = {key: {"model": "trace", "path": str(trace)}, "network.zenoh_config": str(trace)}
    text = edited(text, changes)
    session = parsed(text)
    assert paths_from(session, EXPERIMENTS) == {}
    moves = paths_from(session, tmp_path)
    robots = {"local.robot.path", "remote.robot.path"}
    assert set(moves) == {*robots, f"{key}.path", "network.zenoh_config"}
    assert moves[f"{key}.path"] == "traces/wifi.csv"
    moved = parse_session(edited(text, moves), tmp_path / "moved.toml")
    assert moved.digest == session.digest
    assert Path(moved.local.robot.path).samefile(session.local.robot.path)


NAMES = st.sampled_from(["a", "b", "c-d", "e_1"])
SCALARS = st.one_of(
    st.booleans(),
    st.integers(-(2**60), 2**60),
    st.floats(allow_nan=False),
    st.text(st.characters(codec="utf-8"), max_size=8),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(st.dictionaries(NAMES, inner, max_size=3), max_size=3)
        | st.dictionaries(NAMES, inner, max_size=3)
    ),
    max_leaves=8,
)
DOCUMENTS = st.dictionaries(NAMES, VALUES, max_size=4)


def places(value, key=""):
    """Every key of a document, and one beside it in every table."""
    if isinstance(value, dict):
        prefix = f"{key}." if key else ""
        for name, item in value.items():
            yield f"{prefix}{name}"
            yield from places(item, f"{prefix}{name}")
        yield f"{prefix}new"
        yield f"{prefix}new.table.of_its_own"
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield f"{key}[{index}]"
            yield from places(item, f"{key}[{index}]")


def fits(document, key, value):
    """Whether the key is not an item of an array of tables, or the value is a table."""
    holder = document
    for step in re.findall(r"[\w-]+", key)[:-1]:
        holder = holder.get(step, {}) if isinstance(holder, dict) else holder[int(step)]
    tables = isinstance(holder, list) and all(isinstance(item, dict) for item in holder)
    return isinstance(value, dict) or not tables


def with_change(document, key, value):
    """The same change on plain values, written apart from the one under test."""
    steps = [json.loads(s) if s.isdigit() else s for s in re.split(r"\]?\.|\[|\]", key) if s]
    result = holder = copy.deepcopy(document)
    for step in steps[:-1]:
        if isinstance(holder, dict):
            holder.setdefault(step, {})
        holder = holder[step]
    holder[steps[-1]] = value
    return result


@given(DOCUMENTS, VALUES, st.data())
def test_any_change_means_what_it_would_in_plain_values(document, value, data):
    key = data.draw(st.sampled_from(list(places(document))))
    if fits(document, key, value):
        result = edited(tomlkit.dumps(document), {key: value})
        assert tomllib.loads(result) == with_change(document, key, value)


@given(st.sampled_from(FILES), st.data())
def test_a_change_to_a_session_and_back_keeps_everything(path, data):
    text = path.read_text(encoding="utf-8")
    document = tomllib.loads(text)
    key = data.draw(st.sampled_from([k for k in places(document) if not k.endswith("of_its_own")]))
    value = data.draw(VALUES.filter(lambda value: fits(document, key, value)))
    changed = edited(text, {key: value})
    assert tomllib.loads(changed) == with_change(document, key, value)
    comments = re.findall(r"^#.*", text, flags=re.MULTILINE)
    assert re.findall(r"^#.*", changed, flags=re.MULTILINE) == comments
    steps, back = document, None
    for step in re.split(r"\]?\.|\[|\]", key):
        if step:
            missing = isinstance(steps, dict) and step not in steps
            back = None if missing else steps[int(step) if step.isdigit() else step]
            steps = back
    assert tomllib.loads(edited(changed, {key: back})) == document
