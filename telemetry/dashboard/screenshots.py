"""Pictures of the dashboard, drawn by a viewer without a window."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import rerun as rr
from rerun.experimental import ViewerClient

from telemetry.dashboard.canvas import TIMELINE
from telemetry.dashboard.painter import Arrival, Painter, paint
from telemetry.dashboard.viewers import (
    VIEWER_DEADLINE_S,
    ViewerCrashError,
    headless_viewer,
    pause,
)
from telemetry.picture import Picture

NOTICE_S: Final = 5.0
"""Notices of its start cover a corner of the viewer for no longer than this."""


def screenshot(
    path: Path,
    picture: Picture,
    arrivals: Sequence[Arrival],
    width: int = 1920,
    height: int = 1080,
) -> None:
    """Draw these (batch, arrival [ns]) into a PNG file, as the dashboard looks after the last.

    Uses a viewer without a window, which needs a Vulkan driver; one in software will do.
    TelemetryError if the viewer cannot be started or does not draw.
    """
    try:
        _screenshot(path, picture, arrivals, width, height)
    except ViewerCrashError:
        _screenshot(path, picture, arrivals, width, height)


def _screenshot(
    path: Path, picture: Picture, arrivals: Sequence[Arrival], width: int, height: int
) -> None:
    with headless_viewer(width, height) as client:
        draw(client, picture, arrivals)
        _wait_until_still(client, NOTICE_S)
        client.save_screenshot(str(path))


def draw(client: ViewerClient, picture: Picture, arrivals: Sequence[Arrival]) -> None:
    """Have this viewer show these (batch, arrival [ns]), and wait until it does."""
    painter = Painter(picture, rr.GrpcSink(client.url))
    paint(painter, picture, arrivals)
    deadline = time.monotonic() + VIEWER_DEADLINE_S
    while not any(
        timeline.name == TIMELINE and (timeline.end or 0) >= painter.end_ns
        for recording in client.get_state().recordings
        for timeline in recording.timelines
    ):
        pause(deadline, "did not receive the recording")
    client.set_time(TIMELINE, duration=painter.end_ns * 1e-9, play_state="paused")
    _wait_until_still(client, 0.0)


def _wait_until_still(client: ViewerClient, still_s: float) -> None:
    deadline = time.monotonic() + VIEWER_DEADLINE_S
    shot, since = client.take_screenshot(), time.monotonic()
    while True:
        pause(deadline, "did not come to rest")
        last, shot = shot, client.take_screenshot()
        if shot != last:
            since = time.monotonic()
        elif time.monotonic() - since >= still_s:
            return
