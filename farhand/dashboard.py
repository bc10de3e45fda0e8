"""`farhand dashboard`."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Annotated

import typer

from farhand.console import ERR, user_errors
from farhand.feed import DASHBOARD, Feed
from farhand.picture import picture_of
from site_runtime.daemon import Connect, Duration, SessionPath
from site_runtime.session import Session, load_session
from telemetry.dashboard import Dashboard, LiveServer, RecordingFile, Sink, Viewer, start_viewer

POLL_S = 0.01

Save = Annotated[Path | None, typer.Option("--save", help="Also save what is shown, as FILE.rrd.")]
Port = Annotated[int, typer.Option("--port", help="Loopback port for rerun viewers.")]
As = Annotated[
    str, typer.Option("--as", metavar="NAME", help="Whose certificate to show, of `farhand keys`.")
]
WebPort = Annotated[int, typer.Option("--web-port", help="Loopback port of the web page.")]


def dashboard(
    session: SessionPath,
    connect: Connect = None,
    save: Save = None,
    port: Port = 9876,
    web_port: WebPort = 9090,
    duration: Duration = None,
    observer: As = DASHBOARD,
) -> None:
    """Show a running session live: in a window if there is a display, else as a web page."""
    with user_errors():
        loaded = load_session(session)
        with (
            suppress(KeyboardInterrupt),
            closing(Feed(loaded, connect, observer)) as feed,
            shown(loaded, save, port, web_port) as board,
            reported(feed, board),
        ):
            end_s = None if duration is None else time.monotonic() + duration
            while end_s is None or time.monotonic() < end_s:
                for batch, arrival_ns in feed.receive():
                    board.offer(batch, arrival_ns)
                time.sleep(POLL_S)


@contextmanager
def shown(session: Session, save: Path | None, port: int, web_port: int) -> Iterator[Dashboard]:
    """Open a dashboard with its viewer for as long as the context lasts; print the addresses."""
    live = LiveServer(port)
    sinks: list[Sink] = [live]
    if save is not None:
        sinks.append(RecordingFile(save))
    board = Dashboard(picture_of(session), sinks)
    viewer: Viewer | None = None
    try:
        viewer = start_viewer(live, web_port)
        ERR.print(f"dashboard: {viewer.address}", soft_wrap=True, highlight=False)
        ERR.print(f"   or run: rerun {live.address}", soft_wrap=True, highlight=False)
        yield board
    finally:
        board.close()
        if viewer is not None:
            viewer.close()


@contextmanager
def reported(feed: Feed, board: Dashboard) -> Iterator[None]:
    """Say what to mind of the network, and at the end what was not shown."""
    for warning in feed.warnings:
        ERR.print(warning, style="yellow", highlight=False, markup=False, soft_wrap=True)
    try:
        yield
    finally:
        for count, what in (
            (board.dropped_batches, "batches were not shown: the viewer was too slow"),
            (feed.foreign, "batches were of another session file and not shown"),
            (feed.broken, "payloads were no telemetry of this version"),
        ):
            if count:
                ERR.print(f"{count} {what}", style="yellow", highlight=False)
