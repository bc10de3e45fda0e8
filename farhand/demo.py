"""`farhand demo`: both sites on this machine, each a process, with the dashboard."""

import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from math import inf, isnan
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.live import Live
from rich.table import Table

from farhand.console import ERR, user_errors
from farhand.dashboard import POLL_S, Port, Save, WebPort, shown
from farhand.feed import Feed
from farhand.picture import picture_of
from site_runtime.clock import SteadyClock
from site_runtime.daemon import Duration, StopSignals
from site_runtime.keys import SiteId
from site_runtime.session import load_session
from site_runtime.supervisor import State
from telemetry.dashboard import free_port
from telemetry.dashboard import screenshot as draw_screenshot
from telemetry.stream import Batch

SESSION = Path(__file__).resolve().parent.parent / "experiments" / "demo.toml"
SCREENSHOT_S = 14.0
STATUS_HZ = 4  # the control loops want the processor more than a person wants a faster line
END_S = 10.0


def demo(
    session: Annotated[Path, typer.Option("--session", help="Another session file.")] = SESSION,
    duration: Duration = None,
    save: Save = None,
    port: Port = 9876,
    web_port: WebPort = 9090,
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", help="At the end, draw the dashboard into this PNG file."),
    ] = None,
) -> None:
    """Run both sites of a session on this machine, with the dashboard, until Ctrl-C."""
    with user_errors():
        loaded = load_session(session)
        endpoints = {site: f"tcp/127.0.0.1:{free_port()}" for site in SiteId}
        recent: deque[tuple[Batch, int]] = deque()
        newest: dict[int, Batch] = {}
        status = Live(
            get_renderable=lambda: _status(newest),
            console=ERR,
            refresh_per_second=STATUS_HZ,
            transient=True,
        )
        with (
            StopSignals(SteadyClock(), None) as signals,
            shown(loaded, save, port, web_port) as board,
            _sites(session, endpoints) as processes,
            closing(Feed(loaded, tuple(endpoints.values()))) as feed,
            status,
        ):
            end_s = inf if duration is None else time.monotonic() + duration
            while time.monotonic() < end_s and not signals.asked_to_stop():
                for batch, arrival_ns in feed.receive():
                    board.offer(batch, arrival_ns)
                    newest[batch.site] = batch
                    recent.append((batch, arrival_ns))
                _keep(recent)
                _check_alive(processes)
                time.sleep(POLL_S)
        if screenshot is not None:
            draw_screenshot(screenshot, picture_of(loaded), list(recent))
            ERR.print(f"drawn: {screenshot}")


@contextmanager
def _sites(
    session: Path, endpoints: dict[SiteId, str]
) -> Iterator[dict[SiteId, subprocess.Popen[str]]]:
    """Both daemons as processes; ended as a service would be, their summaries printed."""
    processes: dict[SiteId, subprocess.Popen[str]] = {}
    try:
        for site in (SiteId.REMOTE, SiteId.LOCAL):
            arguments = [str(session), "--quiet", "--listen", endpoints[site]]
            if site is SiteId.LOCAL:
                arguments += ["--connect", endpoints[SiteId.REMOTE]]
            processes[site] = subprocess.Popen(  # noqa: S603
                [sys.executable, "-m", f"{site.label}_site", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,  # the terminal's Ctrl-C reaches them through us
            )
        yield processes
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGTERM)  # quiet also where it has not come to its handlers
        for process in processes.values():
            _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    try:
        out, err = process.communicate(timeout=END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
    sys.stderr.write(err)
    sys.stdout.write(out)


def _check_alive(processes: dict[SiteId, subprocess.Popen[str]]) -> None:
    for site, process in processes.items():
        if process.poll() is not None:
            raise OSError(f"the {site.label} site ended by itself, with code {process.returncode}")


def _keep(recent: deque[tuple[Batch, int]]) -> None:
    """Keep what the dashboard's picture needs."""
    while recent and recent[-1][1] - recent[0][1] > SCREENSHOT_S * 1e9:
        recent.popleft()


def _status(newest: dict[int, Batch]) -> Table:
    table = Table.grid(padding=(0, 2))
    for site in SiteId:
        batch = newest.get(site)
        if batch is None:
            table.add_row(site.label, "starting")
            continue
        rows = batch.rows
        error_mm = 1e3 * float(np.linalg.norm(rows["position_m"][-1] - rows["peer_position_m"][-1]))
        loop_ms = 1e3 * float(rows["loop_bound_s"][-1])
        certified_ms = 1e3 * float(rows["certified_round_trip_s"][-1])
        table.add_row(
            site.label,
            State(rows["state"][-1]).name,
            "no peer yet" if isnan(loop_ms) else f"loop {loop_ms:.0f} of {certified_ms:.0f} ms",
            "" if isnan(error_mm) else f"error {error_mm:.1f} mm",
            f"late {rows['lateness_ns'].max() * 1e-3:.0f} µs",
            f"missed {rows['missed'][-1]}",
        )
    return table
