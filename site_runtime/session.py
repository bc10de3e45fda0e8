"""The session file: TOML that both sites read, as typed, frozen, validated values.

Both sites must hold the same session. `Session.digest` says so: neither comments nor addresses
nor a machine's real-time settings and recordings change it, every other key does.
"""

import hashlib
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import TypeAdapter, ValidationError

from channel.delay import TraceDelay
from hardware.interface import DeviceSettings, HardwareError
from hardware.robot_model import UrdfArm
from site_runtime.keys import SiteId
from site_runtime.network_profiles import fill as fill_profile
from site_runtime.real_time import RealTimeSettings
from site_runtime.session_checks import DIRECTIONS, contradictions
from site_runtime.session_problems import (
    ABSENT,
    Lines,
    Problem,
    SessionError,
    SessionFileError,
    explain,
)
from site_runtime.session_settings import (
    ChannelSettings,
    ConstantOperator,
    CouplingSettings,
    DampingSettings,
    EngagementSettings,
    EnvironmentSettings,
    HumanArmOperator,
    JointLimitsTask,
    LimitSettings,
    LinearSingularityTask,
    LocalSettings,
    LoopSettings,
    ManipulabilityTask,
    NetworkSettings,
    NoOperator,
    NullSpaceSettings,
    ObstacleSettings,
    ObstacleTask,
    OperatorSettings,
    PaperCoupling,
    PaperObstacleTask,
    Pulse,
    PulsesOperator,
    RecorderSettings,
    RemoteSettings,
    SessionFile,
    StiffnessCoupling,
    SubTaskSettings,
    TaskSettings,
    WallSettings,
)

__all__ = [
    "PATH_KEYS",
    "ChannelSettings",
    "ConstantOperator",
    "CouplingSettings",
    "DampingSettings",
    "DeviceSettings",
    "EngagementSettings",
    "EnvironmentSettings",
    "HumanArmOperator",
    "JointLimitsTask",
    "LimitSettings",
    "LinearSingularityTask",
    "LocalSettings",
    "LoopSettings",
    "ManipulabilityTask",
    "NetworkSettings",
    "NoOperator",
    "NullSpaceSettings",
    "ObstacleSettings",
    "ObstacleTask",
    "OperatorSettings",
    "PaperCoupling",
    "PaperObstacleTask",
    "Pulse",
    "PulsesOperator",
    "RealTimeSettings",
    "RecorderSettings",
    "RemoteSettings",
    "Session",
    "SessionError",
    "SessionFileError",
    "StiffnessCoupling",
    "SubTaskSettings",
    "TaskSettings",
    "WallSettings",
    "load_session",
    "parse_session",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Session(SessionFile):
    """A validated session: the file's keys, its text, and the digest that both sites compare."""

    path: Path
    text: str
    digest: int

    def site(self, identity: SiteId) -> LocalSettings | RemoteSettings:
        """Return the settings of one site."""
        return self.local if identity is SiteId.LOCAL else self.remote


NO_FILES: Mapping[str, Path] = MappingProxyType({})
_MOST_TEXT = 100_000
_MOST_LINE = 2_000
_ADAPTER = TypeAdapter(SessionFile)
PATH_KEYS = (
    *(f"{site}.robot.path" for site in ("local", "remote")),
    *(f"channel.{direction}.delay.path" for direction in DIRECTIONS),
    "network.zenoh_config",
    "network.keys",
    "recorder.directory",
)
"""The keys that name files, relative to the session file."""


def named_files(session: Session) -> dict[str, Path]:
    """Return the files that the session names and both sites must agree on, by their keys."""
    named: dict[str, Path] = {}
    for site in ("local", "remote"):
        robot = getattr(session, site).robot
        if isinstance(robot, UrdfArm):
            named[f"{site}.robot.path"] = Path(robot.path)
    for direction in DIRECTIONS:
        delay = getattr(session.channel, direction)
        if delay is not None and isinstance(delay.delay, TraceDelay):
            named[f"channel.{direction}.delay.path"] = Path(delay.delay.path)
    return named


def load_session(path: Path | str) -> Session:
    """Read and validate a session file; raises SessionFileError with every problem found."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SessionFileError(path, [Problem("the file", ABSENT, str(error))]) from error
    return parse_session(text, path)


def parse_session(text: str, path: Path, files: Mapping[str, Path] = NO_FILES) -> Session:
    """Validate a session file's text; paths in it are relative to the folder of `path`.

    `files` are to be read in place of those that it names, by their keys.
    """
    _require_size(text, path)
    try:
        document = tomllib.loads(text)
        _resolve_paths(document, path.resolve().parent, files)
        fill_profile(document)
        # As JSON, strict mode takes a list for a tuple and still refuses "1" for a number.
        as_json = json.dumps(document, default=str)
    except (ValueError, RecursionError) as error:
        raise SessionFileError(path, [Problem("the file", ABSENT, f"not TOML: {error}")]) from None
    lines = Lines(text)
    try:
        file = _ADAPTER.validate_json(as_json)
        problems = list(contradictions(file))
        digest = _digest(file) if not problems else 0
    except ValidationError as error:
        problems = list(explain(error, SessionFile, document))
    except (HardwareError, OSError) as error:
        problems = [Problem("the file", ABSENT, str(error))]
    if problems:
        numbered = [replace(problem, line=lines.of(problem.key)) for problem in problems]
        raise SessionFileError(path, numbered)
    keys = {item.name: getattr(file, item.name) for item in fields(file)}
    return Session(**keys, path=path, text=text, digest=digest)


def _require_size(text: str, path: Path) -> None:
    """Refuse what no session needs: a dotted key of n parts costs tomllib n² bytes and more."""
    longest = max(map(len, text.splitlines()), default=0)
    for length, most, what in ((len(text), _MOST_TEXT, "it"), (longest, _MOST_LINE, "a line")):
        if length > most:
            reason = f"{what} has {length} characters; a session file has at most {most}"
            raise SessionFileError(path, [Problem("the file", ABSENT, reason)])


def _resolve_paths(document: dict[str, Any], folder: Path, files: Mapping[str, Path]) -> None:
    """Make the paths absolute, so that nothing depends on where a daemon is started."""
    for dotted in PATH_KEYS:
        *tables, key = dotted.split(".")
        holder: Any = document
        for table in tables:
            holder = holder.get(table) if isinstance(holder, dict) else None
        if isinstance(holder, dict) and isinstance(holder.get(key), str):
            holder[key] = str(files.get(dotted, folder / holder[key]))


def _digest(file: SessionFile) -> int:
    """64 bits over everything that both sites must agree on."""
    agreed = _plain(file)
    for own in ("network", "real_time", "recorder"):
        del agreed[own]
    canonical = json.dumps(agreed, sort_keys=True, separators=(",", ":"))
    return int.from_bytes(hashlib.blake2b(canonical.encode(), digest_size=8).digest(), "little")


def _plain(value: Any) -> Any:  # noqa: ANN401  JSON in the making
    if is_dataclass(value):
        table = {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
        if isinstance(value, UrdfArm | TraceDelay):
            # Two machines keep the same file in different places.
            table["path"] = hashlib.blake2b(Path(value.path).read_bytes()).hexdigest()
        return table
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value
