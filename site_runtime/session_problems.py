"""What is wrong with a session file, said so that it can be put right.

`SessionError` is what may be caught; `SessionFileError` lists every problem of one file.
"""

import difflib
import json
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import ValidationError
from pydantic.fields import FieldInfo


class _Absent(Enum):
    """A value that is not there; one member, the same in every process."""

    ABSENT = "absent"


ABSENT = _Absent.ABSENT
"""Stands for the value of a key that the file does not have."""

_UNITS = {
    "s": "times in seconds",
    "hz": "rates in hertz",
    "m": "lengths in metres",
    "rad": "angles in radians",
    "rad_s": "angular rates in rad/s",
    "kg": "masses in kilograms",
    "n": "forces in newtons",
    "nm": "torques in newton metres",
    "n_per_m": "stiffness in N/m",
    "n_s_per_m": "damping in N·s/m",
    "nm_s": "joint damping in N·m·s/rad",
    "m_s2": "accelerations in m/s²",
}
_FOREIGN_UNITS = (
    *("ms", "us", "ns", "sec", "seconds", "min", "khz", "ghz", "mhz", "hertz", "rpm"),
    *("mm", "cm", "um", "km", "inch", "metres", "meters", "deg", "degrees", "radians"),
    *("deg_s", "deg_per_s", "rad_per_s", "g", "grams", "kn", "mn", "newton", "newtons"),
    *("n_m", "mnm", "nmm", "n_per_mm", "n_per_cm", "n_m_s", "n_s_m", "n_m", "n_s_per_mm"),
    *("ns_per_m", "nms", "nms_per_rad", "nm_s_per_rad", "m_per_s2", "g0"),
)
_SUFFIXES = sorted({*_UNITS, *_FOREIGN_UNITS}, key=len, reverse=True)
_MOST_TOLD = 200
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


class SessionError(Exception):
    """Anything wrong with a session."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing to put right: the dotted key, its value (or ABSENT), and what is allowed."""

    key: str
    value: object
    reason: str
    line: int | None = None
    meant: str | None = None
    """For an unknown key, the dotted key that it probably stands for."""

    def __str__(self) -> str:
        where = f"line {self.line}: " if self.line is not None else ""
        given = "" if self.value is ABSENT else f" = {_shown(self.value)}"
        return f"{where}{self.key}{given}: {self.reason}"


class SessionFileError(SessionError):
    """A session file that cannot be used; `problems` has every one found."""

    def __init__(self, path: object, problems: Sequence[Problem]) -> None:
        self.path = str(path)
        self.problems = tuple(problems)
        count = f"{len(problems)} problem" + ("s" if len(problems) != 1 else "")
        listed = "\n".join(f"  {problem}" for problem in self.problems)
        super().__init__(f"{path}: {count}\n{listed}")

    def __reduce__(self) -> tuple[type, tuple[str, tuple[Problem, ...]]]:
        """Pickle by what it was made of, so that it comes back from a worker's process."""
        return type(self), (self.path, self.problems)


@cache
def keys_of(table: type) -> Mapping[str, Any]:
    """Return the keys of a table and their annotations."""
    if not is_dataclass(table):
        return {}
    hints = get_type_hints(table, include_extras=True)
    return MappingProxyType({item.name: hints[item.name] for item in fields(table)})


def tables_of(annotation: object) -> tuple[type, ...]:
    """Return the tables that an annotation admits: several for a union."""
    bare = _bare(annotation)
    members = get_args(bare) if _is_union(bare) else (bare,)
    return tuple(member for member in members if isinstance(member, type) and is_dataclass(member))


def tag_of(tables: Sequence[type]) -> tuple[str, dict[str, type]]:
    """Return the key whose literal value tells the tables of a union apart, and whose is which."""
    for key in keys_of(tables[0]):
        literals = [_bare(keys_of(table).get(key)) for table in tables]
        if all(get_origin(literal) is Literal for literal in literals):
            pairs = zip(literals, tables, strict=True)
            return key, {str(name): table for literal, table in pairs for name in get_args(literal)}
    raise TypeError(f"no literal key tells {[table.__name__ for table in tables]} apart")


def describe(annotation: object) -> str:
    """Say in words what a key's value may be."""
    bare, limits, described = _bare(annotation), _limits(annotation), _description(annotation)
    if described:
        return described
    if get_origin(bare) is Literal:
        names = ", ".join(_shown(name) for name in get_args(bare))
        return f"one of {names}" if len(get_args(bare)) > 1 else names
    if get_origin(bare) is tuple:
        items = get_args(bare)
        if len(items) == 2 and items[1] is Ellipsis:
            return f"a list, each item {describe(items[0])}"
        return f"a list of {len(items)}, each item {describe(items[0])}"
    tables = tables_of(annotation)
    if len(tables) > 1:
        key, members = tag_of(tables)
        return f"a table with {key} = one of {', '.join(_shown(name) for name in members)}"
    if tables:
        return f"a table of {', '.join(keys_of(tables[0]))}"
    plain = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    words = plain.get(bare, "a value") if isinstance(bare, type) else "a value"
    return " ".join([words, *([" and ".join(limits)] if limits else [])])


def explain(error: ValidationError, annotation: object, document: object) -> Iterator[Problem]:
    """Turn pydantic's findings about `document`, validated as `annotation`, into problems."""
    details = error.errors(include_url=False)
    found = [
        problem
        for detail in details[:_MOST_TOLD]
        for problem in _explain_one(detail, annotation, document)
    ]
    # A mistyped key is one problem, not also the absence of the key that was meant.
    meant = {problem.meant for problem in found}
    told: set[tuple[str, str]] = set()
    for problem in found:
        absent = problem.value is ABSENT and problem.key in meant
        if not absent and (problem.key, problem.reason) not in told:
            told.add((problem.key, problem.reason))
            yield problem
    if len(details) > _MOST_TOLD:
        reason = f"has {len(details) - _MOST_TOLD} more problems; these are the first"
        yield Problem("the file", ABSENT, reason)


def _explain_one(detail: Mapping[str, Any], annotation: object, value: object) -> Iterator[Problem]:
    parent: type | None = None
    key = ""
    for part in detail["loc"]:
        tables = tables_of(annotation)
        if len(tables) > 1:
            # pydantic tries every table of a union; only what it says of the one meant counts.
            tag, members = tag_of(tables)
            given = value.get(tag, ABSENT) if isinstance(value, dict) else ABSENT
            meant = members.get(given) if isinstance(given, str) else None
            if meant is None:
                yield _wrong_tag(key, tag, given, members, value)
                return
            if part != meant.__name__:
                return
            annotation = meant
        elif isinstance(part, int):
            items = get_args(_bare(annotation))
            annotation = items[0] if items else None
            inside = isinstance(value, list) and part < len(value)
            value = value[part] if inside and isinstance(value, list) else ABSENT
            key = f"{key}[{part}]"
        else:
            parent = tables[0] if tables else None
            annotation = keys_of(parent).get(part) if parent else None
            value = value.get(part, ABSENT) if isinstance(value, dict) else ABSENT
            key = dotted(key, part)
    kind, cause = detail["type"], detail.get("ctx", {}).get("error")
    if kind == "unexpected_keyword_argument" and parent is not None:
        yield _unknown_key(key, str(detail["loc"][-1]), value, list(keys_of(parent)))
    elif kind == "missing":
        yield Problem(key, ABSENT, f"is missing; it must be {describe(annotation)}")
    elif isinstance(cause, NestedProblems):
        for inner in cause.problems:
            yield Problem(f"{key}{inner.key}", inner.value, inner.reason)
    elif cause is not None:
        yield Problem(key or "the file", ABSENT if isinstance(value, dict) else value, str(cause))
    elif annotation is None or not key:
        yield Problem(key or "the file", value if key else ABSENT, detail["msg"])
    else:
        yield Problem(key, value, f"must be {describe(annotation)}")


class NestedProblems(ValueError):  # noqa: N818  carried through pydantic, never seen by a user
    """Problems of a table that was validated on its own; keys begin with a dot."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(str(problem) for problem in problems))


def nearest(name: object, valid: Sequence[str]) -> str:
    """Say what is allowed, and the nearest of it."""
    allowed = ", ".join(_shown(item) for item in valid)
    near = difflib.get_close_matches(str(name), valid, n=1, cutoff=0.5)
    return f"must be one of {allowed}" + (f"; the nearest is {_shown(near[0])}" if near else "")


def dotted(table: str, key: str) -> str:
    """Join a table's dotted key and one of its keys, quoted where TOML would quote it."""
    bare = key if _BARE_KEY.fullmatch(key) else json.dumps(key, ensure_ascii=False)
    return f"{table}.{bare}" if table else bare


class Lines:
    """Where keys stand in a TOML text. Knows headers and `key =` lines, which is nearly all."""

    # Each run of blanks can be matched in one way only: a long one must not take long.
    _HEADER = re.compile(r"(\[\[?)\s*([^\[\]#]*[^\[\]#\s])\s*\]\]?\s*(?:#.*)?$")
    _KEY = re.compile(r"([A-Za-z0-9_.\- \"']*[A-Za-z0-9_.\-\"'])\s*=")

    def __init__(self, text: str) -> None:
        self._lines: dict[str, int] = {}
        counts: dict[str, int] = {}
        table = ""
        for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
            header, key = self._HEADER.match(line), self._KEY.match(line)
            if header:
                table = header[2]
                if header[1] == "[[":
                    counts[table] = counts.get(table, -1) + 1
                    table = f"{table}[{counts[table]}]"
                self._lines.setdefault(table, number)
            elif key:
                self._lines.setdefault(f"{table}.{key[1]}" if table else key[1], number)

    def of(self, key: str) -> int | None:
        """Line of a dotted key, or of what it is part of; None if neither is in the file."""
        while key:
            if key in self._lines:
                return self._lines[key]
            key = key[: max(key.rfind("."), key.rfind("["), 0)]
        return None


def _wrong_tag(
    key: str, tag: str, given: object, members: Mapping[str, type], value: object
) -> Problem:
    names = list(members)
    if not isinstance(value, dict):
        allowed = ", ".join(_shown(name) for name in names)
        return Problem(key, value, f"must be a table with {tag} = one of {allowed}")
    if given is ABSENT:
        allowed = ", ".join(_shown(name) for name in names)
        return Problem(dotted(key, tag), ABSENT, f"is missing; it must be one of {allowed}")
    return Problem(dotted(key, tag), given, nearest(given, names))


def _unknown_key(key: str, name: str, value: object, valid: Sequence[str]) -> Problem:
    """Say which unit is meant, or which valid key is nearest, or what is allowed."""
    other = _other_unit(name, valid)
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    meant = None
    if other is not None:
        meant, unit = other
        advice = f"this file gives {_UNITS[unit]}: {meant}"
    elif near:
        meant = near[0]
        advice = f"the nearest is {meant}"
    else:
        advice = f"allowed here: {', '.join(valid)}"
    table = key[: len(key) - len(dotted("", name))]
    full = None if meant is None else f"{table}{meant}"
    return Problem(key, value, f"{name} is not a key; {advice}", meant=full)


def _other_unit(name: str, valid: Sequence[str]) -> tuple[str, str] | None:
    """Find the valid key that names the same quantity in this file's unit, and that unit."""
    stem, _ = _split_unit(name)
    for candidate in valid:
        candidate_stem, unit = _split_unit(candidate)
        if unit in _UNITS and candidate_stem == stem:
            return candidate, unit
    return None


def _split_unit(name: str) -> tuple[str, str]:
    lowered = name.lower()
    for suffix in _SUFFIXES:
        if lowered.endswith(f"_{suffix}"):
            return lowered[: -len(suffix) - 1], suffix
    return lowered, ""


def _is_union(bare: object) -> bool:
    return get_origin(bare) in (Union, types.UnionType)


def _bare(annotation: object) -> Any:  # noqa: ANN401  an annotation is any object
    """Strip an annotation of its metadata and of `| None`."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if _is_union(annotation):
        members = [member for member in get_args(annotation) if member is not types.NoneType]
        if len(members) == 1:
            return _bare(members[0])
        if len(members) < len(get_args(annotation)):
            return Union[tuple(members)]  # noqa: UP007  built at run time
    return annotation


def _limits(annotation: object) -> list[str]:
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    found: list[str] = []
    if _is_union(annotation):
        for member in get_args(annotation):
            found += _limits(member)
    if get_origin(annotation) is Annotated:
        metadata = [
            item
            for given in get_args(annotation)[1:]
            for item in (given.metadata if isinstance(given, FieldInfo) else [given])
        ]
        for item in metadata:
            for name, word in words.items():
                limit = getattr(item, name, None)
                if limit is not None:
                    found.append(f"{word} {limit:g}")
        found += _limits(get_args(annotation)[0])
    return found


def _description(annotation: object) -> str | None:
    if _is_union(annotation):
        members = [member for member in get_args(annotation) if member is not types.NoneType]
        return _description(members[0]) if len(members) == 1 else None
    given = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    found = [item.description for item in given if isinstance(item, FieldInfo)]
    return next((words for words in found if words), None)


def _shown(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."
