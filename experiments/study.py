"""A study: the cases it needs, and what it says of their outcomes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from experiments.case import Case, Outcome
from experiments.report import Section
from site_runtime.session_edit import TomlValue

Outcomes: TypeAlias = Mapping[str, Outcome]


@dataclass(frozen=True, slots=True)
class Study:
    """`section` reads the outcomes by their cases' names and draws its figures into a folder."""

    name: str
    title: str
    cases: tuple[Case, ...]
    section: Callable[[Outcomes, Path], Section]


def both_ways(key: str, value: TomlValue | None) -> dict[str, TomlValue | None]:
    """Return the changes that set a key of [channel.…] alike in both directions."""
    return {f"channel.{way}.{key}": value for way in ("local_to_remote", "remote_to_local")}
