"""Session files that somebody broke: a session, or a list of problems, and soon."""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from site_runtime.session import Session, SessionFileError, load_session, parse_session

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
FILES = sorted(EXPERIMENTS.glob("*.toml"))
SLOW_S = 2.0


def outcome(parse: Callable[[], Session]) -> Session | SessionFileError:
    """What parsing gives; nothing else may come of it."""
    try:
        return parse()
    except SessionFileError as error:
        given = error
    assert given.problems
    assert all(problem.key and problem.reason for problem in given.problems)
    assert all(str(problem) in str(given) for problem in given.problems)
    return given


def soon(text: str) -> Session | SessionFileError:
    """The same, in less than two seconds of this process's own time."""
    began_s = time.process_time()
    given = outcome(lambda: parse_session(text, EXPERIMENTS / "of_a_test.toml"))
    assert time.process_time() - began_s < SLOW_S
    return given


@cache
def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


texts = st.sampled_from(FILES).map(text_of)
numbers = st.sampled_from(
    [
        *("inf", "-inf", "nan", "1e308", "-1e308", "1e309", "5e-324", "-0.0", "0", "-1", "0.5"),
        *("1" * 20, "1" + "0" * 400, "-1" + "0" * 400, "9" * 1900, "9" * 5000, "0x" + "f" * 300),
    ]
)
others = st.sampled_from(
    [
        *("true", '""', '"x"', '"nan"', "[]", "{}", "[[]]", "[{}]", "1979-05-27", "07:32:00"),
        *('"\\u0000"', '"../x"', '"/dev/null"', '"."', '"\\U0001F916"', '"\\u202E"', "1..2", "="),
        *("[", '"""', "2020-01-01T00:00:00Z", "[" + "1," * 900 + "]", "[" + '"x",' * 400 + "]"),
        *("{a=" * 150 + "1" + "}" * 150, "[" * 300 + "]" * 300, '"' + "a" * 1800 + '"'),
    ]
)
names = st.sampled_from(
    ["kind", "model", "path", "a b", "ä", "", "a.b", "delay_ms", "\u202e", "q" * 1800]
)
names |= st.text(st.characters(codec="utf-8"), max_size=4)


@settings(deadline=None, max_examples=60)
@given(texts, st.data())
def test_a_value_of_any_kind(text: str, data: st.DataObject) -> None:
    lines = text.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        places = [place for place, line in enumerate(lines) if "=" in line and line[:1].isalpha()]
        place = data.draw(st.sampled_from(places))
        key = lines[place].partition("=")[0]
        lines[place] = f"{key}= {data.draw(numbers | others)}"
    soon("\n".join(lines))


def tables(table: Any) -> list[Any]:
    """A document and all tables in it."""
    found = [table] if isinstance(table, dict) else []
    for value in table.values() if isinstance(table, dict) else table:
        if isinstance(value, dict | list):
            found += tables(value)
    return found


@settings(deadline=None, max_examples=80)
@given(texts, st.data())
def test_keys_deleted_renamed_moved_and_copied(text: str, data: st.DataObject) -> None:
    document = tomlkit.parse(text).unwrap()
    for _ in range(data.draw(st.integers(1, 3))):
        source, target = (
            data.draw(st.sampled_from([table for table in tables(document) if table]))
            for _ in range(2)
        )
        key = data.draw(st.sampled_from(sorted(source)))
        action = data.draw(st.sampled_from(["delete", "rename", "move", "copy", "repeat"]))
        value = tomlkit.parse(tomlkit.dumps({"value": source[key]})).unwrap()["value"]
        if action in ("delete", "rename", "move"):
            del source[key]
        if action == "rename":
            source[data.draw(names)] = value
        elif action in ("move", "copy"):
            target[key] = value
        elif action == "repeat":
            source[key] = [value] * data.draw(st.sampled_from([0, 1, 2, 20]))
        if not document:
            return
    soon(tomlkit.dumps(document))


@settings(deadline=None, max_examples=80)
@given(texts, st.data())
def test_lines_repeated_removed_exchanged_and_cut(text: str, data: st.DataObject) -> None:
    lines = text.splitlines(keepends=True)
    for _ in range(data.draw(st.integers(1, 4))):
        first, second = (data.draw(st.integers(0, len(lines) - 1)) for _ in range(2))
        action = data.draw(st.sampled_from(["repeat", "exchange", "cut", "remove"]))
        if action == "repeat":
            lines.insert(first, lines[second])
        elif action == "exchange":
            lines[first], lines[second] = lines[second], lines[first]
        elif action == "cut":
            lines[first] = lines[first][: data.draw(st.integers(0, 80))]
        elif len(lines) > 1:
            del lines[first]
    soon("".join(lines))


@settings(deadline=None, max_examples=80)
@given(texts, st.integers(0, 5000), st.integers(0, 40), st.text(max_size=30))
def test_any_text_in_the_middle_of_a_file(text: str, place: int, over: int, junk: str) -> None:
    soon(text[:place] + junk + text[place + over :])


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=200), st.sampled_from(FILES), st.integers(0, 5000), st.booleans())
def test_any_bytes(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, path: Path, place: int, alone: bool
) -> None:
    file = tmp_path_factory.getbasetemp() / "junk.toml"
    whole = path.read_bytes()
    file.write_bytes(junk if alone else whole[:place] + junk + whole[place:])
    outcome(lambda: load_session(file))


@pytest.mark.parametrize("depth", [100, 190, 200, 250, 330, 900, 100_000])
@pytest.mark.parametrize(
    "nest",
    [
        lambda n: "y=" + "[" * n + "]" * n,
        lambda n: "y=" + "{a=" * n + "1" + "}" * n,
        lambda n: ".".join("a" * n) + " = 1",
        lambda n: "[" + ".".join("a" * n) + "]",
        lambda n: "[[" + ".".join("a" * n) + "]]",
        lambda n: "local.device." + ".".join("a" * n) + " = 1",
    ],
)
def test_deep_nesting(depth: int, nest: Any) -> None:
    assert isinstance(soon(nest(depth) + "\n" + text_of(FILES[0])), SessionFileError)


@pytest.mark.parametrize(
    ("part", "count"),
    [
        ("[k{}]\n", 9000),
        ("[[remote.obstacles]]\nname = 1\n", 2500),
        ("[[remote.obstacles]]\n", 4000),
        ("# " + " " * 90 + "\n", 1000),
        ("    k{} = 1\n", 7000),
        ('[[remote.sub_tasks]]\nkind = "x"\n', 2500),
    ],
)
def test_very_many(part: str, count: int) -> None:
    """A person is told the first few hundred of ten thousand problems, not made to wait for all."""
    text = text_of(EXPERIMENTS / "paper_free.toml")
    given = soon(text + "".join(part.format(number) for number in range(count)))
    assert isinstance(given, Session) or len(given.problems) <= 1000


@pytest.mark.parametrize("line", ["{}# x", "[{}x", "[ a{}x", '"""{}"""', "a{}x", "[ a ]{}x"])
def test_a_long_run_of_blanks(line: str) -> None:
    """In a text of several lines TOML allows it all; finding a problem's line must not hang."""
    text = "x = '''\n" + line.format(" " * 1900) + "\n'''\n" + text_of(FILES[0])
    given = soon(text)
    assert isinstance(given, SessionFileError)
    assert given.problems[0].line == 1


@pytest.mark.parametrize(
    ("length", "what"), [(1_900, "x is not a key"), (3_000, "a line"), (200_000, "it")]
)
def test_what_is_too_long_for_a_session(length: int, what: str) -> None:
    given = soon("x = '" + "a" * length + "'\n" + text_of(FILES[0]))
    assert isinstance(given, SessionFileError)
    assert given.problems[0].reason.startswith(what)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "0x" + "f" * 300, "10001"])
def test_a_rate_beyond_all_bounds(number: str) -> None:
    given = soon(text_of(FILES[0]).replace("[channel]\n", f"[channel]\nsend_rate_hz = {number}\n"))
    assert isinstance(given, SessionFileError)
    assert given.problems[0].key == "channel.send_rate_hz"
