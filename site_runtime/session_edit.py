"""Session texts changed key by key, the comments and the layout kept."""

import json
import os
import re
import tomllib
from collections.abc import Mapping, MutableMapping, MutableSequence, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import AoT, InlineTable, Table

from site_runtime.session import PATH_KEYS, Session, SessionError

TomlValue = bool | int | float | str | Sequence["TomlValue"] | Mapping[str, "TomlValue"]

_KEY = re.compile(r"[A-Za-z0-9_-]+(\[\d+\])*(\.[A-Za-z0-9_-]+(\[\d+\])*)*")
_STEP = re.compile(r"[A-Za-z0-9_-]+|\[\d+\]")


def edited(text: str, changes: Mapping[str, TomlValue | None]) -> str:
    """Return the TOML `text` with keys set, in order: {"remote.obstacles[0].center_m": [0.1, 0.3]}.

    Missing tables are created. A table as a value replaces the whole table; None removes the key,
    if it is there. Raises SessionError for a text that is not TOML, or a key that cannot be set.
    """
    try:
        wanted, document = tomllib.loads(text), tomlkit.parse(text)
    except ValueError as error:
        raise SessionError(f"not TOML: {error}") from error
    for key, value in changes.items():
        plain = None if value is None else _plain(value)
        for root in (wanted, document):
            _set(root, key, plain)
    result = document.as_string()
    # A layout that tomlkit mistakes must not become a session with other values.
    if _canonical(tomllib.loads(result)) != _canonical(wanted):
        raise SessionError(
            f"{', '.join(changes)} cannot be changed in this layout; "
            "write every table's own tables directly after it"
        )
    return result


def paths_from(session: Session, folder: Path) -> dict[str, TomlValue]:
    """Return the changes that let a session file stand in another folder: the paths it names."""
    found: dict[str, TomlValue] = {}
    if folder.resolve() != session.path.resolve().parent:
        for key in PATH_KEYS:
            value: Any = session
            for name in key.split("."):
                value = getattr(value, name, None)
            if isinstance(value, str):
                found[key] = os.path.relpath(value, folder.resolve())
    return found


def _set(root: MutableMapping[str, Any], key: str, value: Any) -> None:  # noqa: ANN401  TOML
    if not _KEY.fullmatch(key):
        raise SessionError(f"{key!r} is not a key; write it as remote.obstacles[0].center_m")
    steps = [int(s[1:-1]) if s.startswith("[") else s for s in _STEP.findall(key)]
    holder: Any = root
    passed = []
    for depth, step in enumerate(steps):
        if not _holds(holder, step):
            raise SessionError(f"{key} cannot be set: {_dotted(steps[:depth])} is {_kind(holder)}")
        passed.append((holder, step))
        if depth < len(steps) - 1:
            if isinstance(step, str) and step not in holder:
                if value is None:
                    return
                holder[step] = {}
            holder = holder[step]
    if isinstance(holder, AoT) and not isinstance(value, dict | None):
        raise SessionError(f"{key} is a table; only a table can stand there")
    _assign(holder, steps[-1], value)
    for holder, step in passed[-2:]:
        there = holder.get(step) if isinstance(step, str) else None
        if isinstance(there, Table) and there.is_super_table() and not there:
            # It had no header of its own, and nothing is left that would imply one.
            holder[step] = tomlkit.table(is_super_table=False)


def _holds(holder: Any, step: str | int) -> bool:  # noqa: ANN401  TOML
    if isinstance(step, str):
        return isinstance(holder, MutableMapping)
    return isinstance(holder, MutableSequence) and step < len(holder)


def _assign(holder: Any, step: str | int, value: Any) -> None:  # noqa: ANN401  TOML
    if value is None:
        if isinstance(step, int) or step in holder:
            del holder[step]
        return
    there = holder[step] if isinstance(step, int) else holder.get(step)
    if isinstance(value, dict) and isinstance(there, InlineTable):
        inline = tomlkit.inline_table()
        inline.update(value)
        holder[step] = inline
    elif isinstance(value, dict) and isinstance(there, MutableMapping):
        # In place, so that the table keeps its comments.
        for name in [name for name in there if name not in value]:
            del there[name]
        for name, item in value.items():
            _assign(there, name, item)
    else:
        holder[step] = value


def _plain(value: TomlValue) -> Any:  # noqa: ANN401  TOML
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value


def _dotted(steps: Sequence[str | int]) -> str:
    names = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in steps)
    return "".join(names).removeprefix(".")


def _kind(value: Any) -> str:  # noqa: ANN401  TOML
    if isinstance(value, MutableMapping):
        return "a table"
    if isinstance(value, MutableSequence):
        return f"a list of {len(value)}"
    return f"{value!r}"


def _canonical(document: Mapping[str, Any]) -> str:
    return json.dumps(document, sort_keys=True, default=str)
