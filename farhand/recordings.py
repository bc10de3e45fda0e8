"""What the commands that read recordings share: their arguments, and the session recorded."""

import atexit
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, TypeAlias

import typer

from farhand.console import ERR
from site_runtime.session import (
    PATH_KEYS,
    Session,
    SessionError,
    load_session,
    parse_session,
)
from telemetry.recording import SESSION_FILE
from telemetry.rows import TelemetryError
from telemetry.takes import Take

Recordings: TypeAlias = Annotated[
    list[Path],
    typer.Argument(metavar="FILE...", help="Recordings (.mcap) of one or both sites, or folders."),
]
TakeNumber: TypeAlias = Annotated[
    int | None, typer.Option("--take", help="Which, if the recordings hold several.")
]
SessionFile: TypeAlias = Annotated[
    Path | None,
    typer.Option("--session", help="The session's file, if it names files that are not here."),
]


def session_of(take: Take, recording: Path, original: Path | None) -> Session:
    """Return the session that was recorded: from its original file, or from the recording.

    Files that the text names are taken from the recording, or else looked for beside `recording`.
    TelemetryError if it is
    not to be had, or the original is another session.
    """
    digest = take.metadata["digest"]
    if original is not None:
        session = load_session(original)
        if f"{session.digest:016x}" != digest:
            raise TelemetryError(
                f"{original} is session {session.digest:016x}; recorded was {digest}"
            )
        return session
    hint = "name the original with --session"
    if not take.session_text:
        raise TelemetryError(f"the recording ends before its session file: {hint}")
    folder = recording if recording.is_dir() else recording.parent
    try:
        session = parse_session(take.session_text, folder / SESSION_FILE, _laid_out(take))
    except SessionError as error:
        raise TelemetryError(f"as recorded, {error}\n{hint}") from error
    if f"{session.digest:016x}" != digest:
        ERR.print(
            f"the session as recorded reads as {session.digest:016x}, but was {digest}: "
            f"a file that it names may differ; {hint}",
            style="yellow",
            soft_wrap=True,
            highlight=False,
        )
    return session


def _laid_out(take: Take) -> dict[str, Path]:
    """Write what the session names, as it was recorded, into files that last as long as we do."""
    recorded = take.runs[0].session_files
    if not recorded:
        return {}
    folder = TemporaryDirectory(prefix="farhand-session-")
    atexit.register(folder.cleanup)
    files = {key: Path(folder.name) / key for key in PATH_KEYS if key in recorded}
    for key, file in files.items():
        file.write_bytes(recorded[key])
    return files
