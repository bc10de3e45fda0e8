"""`farhand replay`: recordings on the dashboard, as if they came live."""

import math
import time
from typing import Annotated

import typer

from farhand.console import ERR, user_errors
from farhand.dashboard import POLL_S, Port, Save, WebPort, shown
from farhand.recordings import Recordings, SessionFile, TakeNumber, session_of
from site_runtime.clock import SteadyClock
from site_runtime.daemon import StopSignals
from telemetry.dashboard import Dashboard
from telemetry.rows import TelemetryError
from telemetry.takes import Take, describe, read_take

MOST_WAITING = 100
"""Batches that wait to be drawn: a replay waits for the viewer, and so drops nothing."""

MAX = "max"


def _speed(text: str | float) -> float:
    try:
        speed = math.inf if text == MAX else float(text)
    except ValueError:
        speed = math.nan
    if not speed >= 0.0:
        raise typer.BadParameter(f"{text!r} is no speed: a number such as 0.5, or {MAX}")
    return speed or math.inf


def replay(
    files: Recordings,
    speed: Annotated[
        float,
        typer.Option(
            "--speed", parser=_speed, metavar="X", help="1 as it was; 0 or max: as fast as it goes."
        ),
    ] = 1.0,
    start: Annotated[
        float | None, typer.Option("--start", help="Begin at this session time [s].")
    ] = None,
    take: TakeNumber = None,
    session: SessionFile = None,
    save: Save = None,
    port: Port = 9876,
    web_port: WebPort = 9090,
    leave: Annotated[
        bool, typer.Option("--quit", help="End with the recording, not by Ctrl-C.")
    ] = False,
) -> None:
    """Show recordings of one or both sites on the dashboard, at any speed."""
    with user_errors():
        chosen = read_take(files, take)
        loaded = session_of(chosen, files[0], session)
        with (
            StopSignals(SteadyClock(), None) as signals,
            shown(loaded, save, port, web_port) as board,
        ):
            ERR.print(describe(chosen), highlight=False, soft_wrap=True)
            _play(chosen, board, signals, speed, start)
            if not leave and not signals.asked_to_stop():
                ERR.print("that was all; Ctrl-C closes the dashboard", highlight=False)
            while not (leave or signals.asked_to_stop()):
                time.sleep(POLL_S)


def _play(
    take: Take, board: Dashboard, signals: StopSignals, speed: float, start_s: float | None
) -> None:
    """Offer every batch when its time has come, and the viewer has room."""
    arrivals = take.arrivals(None if start_s is None else round(start_s * 1e9))
    if not arrivals:
        end_s = take.span_ns[1] * 1e-9
        raise TelemetryError(f"--start {start_s:g}: the recording ends at {end_s:.3f} s")
    begin_s, first_ns = time.monotonic(), arrivals[0][1]
    for batch, session_ns in arrivals:
        due_s = begin_s + (session_ns - first_ns) * 1e-9 / speed
        while time.monotonic() < due_s or board.waiting_batches >= MOST_WAITING:
            if signals.asked_to_stop():
                return
            time.sleep(POLL_S)
        if signals.asked_to_stop():
            return
        board.offer(batch, session_ns)
