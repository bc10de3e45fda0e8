"""Viewers as child processes: a window, a web page, or one without a window for pictures."""

import os
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from typing import Final

from rerun.experimental import ViewerClient

from telemetry.dashboard.board import LiveServer
from telemetry.rows import TelemetryError

VIEWER_DEADLINE_S: Final = 60.0


class ViewerCrashError(TelemetryError):
    """A headless viewer was ended by a signal, as drivers in software sometimes do: try again."""


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer started as a child process; `address` is its window's name or its web page."""

    process: subprocess.Popen[bytes]
    address: str

    def close(self) -> None:
        """End the viewer."""
        _end(self.process)


def start_viewer(live: LiveServer, web_port: int = 9090) -> Viewer:
    """Start a viewer of a live dashboard: a window if there is a display, else a web page.

    The page is served on loopback only; over a network, forward both ports through ssh.
    """
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        arguments = ["--port", str(free_port()), "--hide-welcome-screen", live.address]
        return Viewer(_start_rerun(arguments), "window")
    arguments = ["--serve-web", "--web-viewer-port", str(web_port), live.address]
    viewer = Viewer(
        _start_rerun(arguments),
        f"http://127.0.0.1:{web_port}/?url={live.address.replace('+', '%2B')}",
    )
    _wait_for_port(web_port, viewer.process)
    return viewer


@contextmanager
def headless_viewer(
    width: int = 1920, height: int = 1080, live: LiveServer | None = None
) -> Iterator[ViewerClient]:
    """Run a viewer without a window, on loopback, for as long as the context lasts.

    It shows a live dashboard, or waits to be sent something.
    """
    port = free_port()
    size = ["--headless", "--window-size", f"{width}x{height}", "--hide-welcome-screen"]
    shown = [] if live is None else [live.address]
    process = _start_rerun(["--port", str(port), *size, *shown])
    try:
        _wait_for_port(port, process)
        yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
    except Exception as error:
        if (process.poll() or 0) < 0:
            raise ViewerCrashError(
                f"the viewer was ended by signal {-process.returncode}"
            ) from error
        raise
    finally:
        _end(process)


def pause(deadline: float, failure: str) -> None:
    """Wait a little; TelemetryError after the deadline [s, monotonic]."""
    if time.monotonic() > deadline:
        raise TelemetryError(f"the viewer {failure} within {VIEWER_DEADLINE_S:.0f} s")
    time.sleep(0.2)


def _start_rerun(arguments: list[str]) -> subprocess.Popen[bytes]:
    # The binary itself, not its Python launcher: ending the launcher would leave a viewer behind.
    binary = str(files("rerun_cli") / "rerun")
    return subprocess.Popen(  # noqa: S603
        [binary, "--bind", "127.0.0.1", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"RERUN_APP_ONLY": "true"},
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def free_port() -> int:
    """Return a loopback port that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _wait_for_port(port: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + VIEWER_DEADLINE_S
    while True:
        if process.poll() is not None:
            raise TelemetryError(
                f"the viewer ended at once with code {process.returncode}: is a graphics driver "
                "installed (Debian: mesa-vulkan-drivers), and is the port free?"
            )
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        pause(deadline, f"did not open port {port}")
