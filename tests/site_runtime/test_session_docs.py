"""docs/session_file.md and the schema say the same."""

import json
import re
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import get_args

import pytest

from hardware.registry import driver, drivers, force_sensor, force_sensors
from site_runtime.session import SessionFileError, parse_session
from site_runtime.session_problems import keys_of, tables_of
from site_runtime.session_settings import SessionFile

DOC = Path(__file__).parents[2] / "docs" / "session_file.md"


def sections():
    """Rows (key, allowed, default, meaning) by heading."""
    found = {}
    rows = None
    for line in DOC.read_text(encoding="utf-8").splitlines():
        if line.startswith("### "):
            rows = found.setdefault(line[4:], {})
        elif rows is not None and (row := re.match(r"\| `(\w+)` \| (.*?) \| (.*?) \| ", line)):
            rows[row[1]] = (row[2], row[3])
    return found


def tables(annotation):
    """All tables below an annotation; the drivers' settings stand for a device and a sensor."""
    reached = list(tables_of(annotation))
    for argument in get_args(annotation):
        reached += tables(argument)
    for table in list(reached):
        for inner in keys_of(table).values():
            reached += tables(inner)
    return list(dict.fromkeys(reached))


def schema_tables():
    return [
        *tables(SessionFile),
        *(driver(name).settings for name in drivers()),
        *(force_sensor(name).settings for name in force_sensors()),
    ]


def default_of(item: Field):
    if item.default is MISSING and item.default_factory is MISSING:
        return "required"
    if item.default is None or item.default == ():
        return "none"
    if item.default is MISSING or hasattr(item.default, "__dataclass_fields__"):
        return None  # described in words
    return f"`{json.dumps(item.default)}`"


def test_every_table_has_its_section_with_all_keys_and_no_other():
    written = [frozenset(rows) for rows in sections().values()]
    schema = schema_tables()
    assert len(schema) > 30
    assert sorted(map(sorted, written)) == sorted(sorted(keys_of(table)) for table in schema)


def test_defaults_are_the_schema_s():
    schema = schema_tables()
    for table in schema:
        keys = {item.name: item for item in fields(table)}
        # tables with the same keys and different literals are told apart by their defaults
        candidates = [rows for rows in sections().values() if set(rows) == set(keys)]
        assert any(
            all(default_of(item) in (None, rows[key][1]) for key, item in keys.items())
            for rows in candidates
        ), table


def test_the_example_in_the_page_is_what_a_user_gets():
    demo = DOC.parents[1] / "experiments" / "demo.toml"
    text = demo.read_text(encoding="utf-8")
    text = text.replace("mean_s = 0.05", "mean_ms = 50", 1).replace("[0.1, 0.1]", "[0.1, -0.1]", 1)
    with pytest.raises(SessionFileError) as caught:
        parse_session(text, demo)
    shown = str(caught.value).replace(str(demo), demo.name)
    page = DOC.read_text(encoding="utf-8")
    lines = re.compile(r"line \d+")  # the example need not follow every edit of the demo
    assert lines.sub("line", shown) in lines.sub("line", page), shown
