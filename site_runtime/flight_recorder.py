"""The flight recorder of a daemon: where it writes, and what it is told."""

import os
import time
from pathlib import Path

from site_runtime.clock import SteadyClock
from site_runtime.session import Session, named_files
from site_runtime.site import Site
from site_runtime.supervisor import State
from telemetry.companion import SharedMemory
from telemetry.recorder import RecorderOptions
from telemetry.recorder_process import RecorderProcess

INCIDENT_STATES = ("FAULT", "EMERGENCY_STOP")
"""Entering one of these is an incident: the rows around it are never deleted."""


def recorder_folder(session: Session, site_label: str) -> Path:
    """Folder of a site's recordings: in the session file's directory, or the user's state."""
    own = session.recorder.directory
    return (_state_home() / "farhand" if own is None else Path(own)) / session.name / site_label


def start_recorder(session: Session, site: Site, memory: SharedMemory) -> RecorderProcess:
    """Record a site that stands on the steady clock and keeps its rows in `memory`.

    Raises TelemetryError if nothing can be recorded.
    """
    label = site.identity.label
    return RecorderProcess(
        site.telemetry.ring,
        memory,
        RecorderOptions(
            folder=str(recorder_folder(session, label)),
            keep_s=session.recorder.keep_s,
            session_name=session.name,
            session_text=session.text,
            session_files={key: str(path) for key, path in named_files(session).items()},
            site=label,
            wall_offset_ns=time.time_ns() - SteadyClock().now_ns(),
            states={state.value: state.name for state in State},
            incident_states=INCIDENT_STATES,
        ),
    )


def _state_home() -> Path:
    # XDG Base Directory Specification: a relative path is to be ignored.
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    return home if home.is_absolute() else Path.home() / ".local" / "state"
