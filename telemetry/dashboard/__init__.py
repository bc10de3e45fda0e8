"""The dashboard: both sites' rows as one live picture, in a process of its own.

The only package that imports rerun. A viewer that stalls blocks whoever logs to it, so every sink
has a pump: a queue that drops the oldest batches, and one thread that makes all rerun calls.
"""

from telemetry.dashboard.board import (
    Dashboard,
    LiveServer,
    RecordingFile,
    Sink,
    save_recording,
)
from telemetry.dashboard.painter import Arrival, Painter
from telemetry.dashboard.screenshots import draw, screenshot
from telemetry.dashboard.viewers import (
    Viewer,
    ViewerCrashError,
    free_port,
    headless_viewer,
    start_viewer,
)

__all__ = [
    "Arrival",
    "Dashboard",
    "LiveServer",
    "Painter",
    "RecordingFile",
    "Sink",
    "Viewer",
    "ViewerCrashError",
    "draw",
    "free_port",
    "headless_viewer",
    "save_recording",
    "screenshot",
    "start_viewer",
]
