"""What viewers show of the dashboard: every view, to those that come late too, and stalled ones."""

import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import rerun as rr
from rerun.experimental import ViewerClient

from telemetry.dashboard import (
    Arrival,
    Dashboard,
    LiveServer,
    draw,
    headless_viewer,
    screenshot,
)
from telemetry.picture import LOCAL_COLOUR, RED, REMOTE_COLOUR
from tests.ports import free_port
from tests.telemetry.boards import (
    MS,
    PASSAGES_NS,
    Chain,
    count_of,
    driverless,
    picture_of,
    pixels,
    retried,
    wait_for,
)

pytestmark = [driverless, pytest.mark.viewer]

PLOTS = {
    "Position error [mm] · white: between the points": (LOCAL_COLOUR, REMOTE_COLOUR),
    "Force [N] · pale: of the coupling": (LOCAL_COLOUR, REMOTE_COLOUR),
    "Energy of the proof [J] · thin: its parts": (),
    "Energy put in [J] · pale: taken out by damping": (LOCAL_COLOUR, REMOTE_COLOUR),
    "One-way delay [ms]": (LOCAL_COLOUR, REMOTE_COLOUR),
    "Margin of the certificate [ms]": (REMOTE_COLOUR, RED),
    "Loop lateness [µs]": (LOCAL_COLOUR, REMOTE_COLOUR),
}
ARMS = {
    "Local · 2 joints · dim: remote as received": (LOCAL_COLOUR, REMOTE_COLOUR),
    "Remote · 3 joints · dim: local as received": (REMOTE_COLOUR, LOCAL_COLOUR),
}
TABS = ("Torques [N·m]", "Angles [rad]", "Speeds [rad/s]", "Loop age [ms]", "Clearance [mm]")
ENGAGED = (50, 125, 66)  # as the viewer darkens it
INK = 200


def views_of(dimension: int) -> dict[str, str]:
    return (
        dict.fromkeys((*PLOTS, *TABS), "TimeSeries")
        | dict.fromkeys(ARMS, f"{dimension}D")
        | {
            "Events": "TextLog",
            "Supervisor": "StateTimeline",
            "Certificate": "TextDocument",
            "Latency [ms] · median / p99 of 5 s": "TextDocument",
        }
    )


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def end_ns(client: ViewerClient) -> int:
    ends = [
        timeline.end or 0
        for recording in client.get_state().recordings
        for timeline in recording.timelines
        if timeline.name == "t"
    ]
    return max(ends, default=0)


def complaints(client: ViewerClient) -> list[str]:
    reports = [f"{view.name}: {view.reports}" for view in client.get_state().views if view.reports]
    logs = [
        entry.message
        for entry in client.get_logs()
        if entry.level != "INFO" and "Software rasterizer" not in entry.message
    ]
    return reports + logs


def check_views(client: ViewerClient, dimension: int) -> None:
    """Every view is there, content, and in the colours of what it shows."""
    state = client.get_state()
    assert {view.name: view.view_class for view in state.views} == views_of(dimension)
    assert complaints(client) == []
    shots = {
        view.name: pixels(client.take_screenshot(view.view_id))
        for view in state.views
        if view.name not in TABS
    }
    for name, (own, peer) in ARMS.items():
        assert count_of(shots[name], own) > 1000, name
        assert count_of(shots[name], peer) < 100, name
    for name, colours in PLOTS.items():
        for colour in colours:
            assert count_of(shots[name], colour) > 200, (name, colour)
    assert count_of(shots["Supervisor"], ENGAGED) > 1000
    for name in ("Certificate", "Latency [ms] · median / p99 of 5 s", "Events"):
        assert (shots[name].min(axis=2) > INK).sum() > 200, name


def while_in_contact(run: Any) -> list[Arrival]:
    """Batches of seconds in which every force is to be seen."""
    return [item for item in run.batches(PASSAGES_NS) if 109_000 * MS < item[1] < 115_000 * MS]


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_viewer_shows_every_view(
    run: Any, spatial_run: Any, chain: Chain, dimension: int
) -> None:
    def attempt() -> None:
        with headless_viewer() as client:
            shown = run if dimension == 2 else spatial_run
            draw(client, picture_of(chain, dimension), while_in_contact(shown))
            assert end_ns(client) == 9_999 * MS
            check_views(client, dimension)

    retried(attempt)


def test_a_screenshot_is_a_picture_of_the_size_asked_for(
    run: Any, chain: Chain, tmp_path: Path
) -> None:
    path = tmp_path / "run.png"
    screenshot(path, picture_of(chain), run.batches(PASSAGES_NS)[:60], 1280, 720)
    image = pixels(path.read_bytes())
    assert image.shape == (720, 1280, 3)
    assert count_of(image, LOCAL_COLOUR) > 300
    assert count_of(image, REMOTE_COLOUR) > 300


def offered(shown: Dashboard, arrivals: list[Arrival]) -> None:
    """Offer no faster than they are drawn, so that none is dropped."""
    for batch, arrival_ns in arrivals:
        wait_for(lambda: shown.waiting_batches < 100)
        shown.offer(batch, arrival_ns)


def still_at(client: ViewerClient, time_ns: int) -> None:
    """Wait until a viewer has what was drawn up to a time, and stop it there."""
    wait_for(lambda: end_ns(client) >= time_ns)
    client.set_time("t", duration=time_ns * 1e-9, play_state="paused")
    shot = b""
    while shot != (shot := client.take_screenshot()):
        time.sleep(0.2)


def test_two_dashboards_and_a_viewer_that_comes_late_show_everything(
    run: Any, chain: Chain
) -> None:
    def attempt() -> None:
        lives = [LiveServer(free_port()) for _ in range(2)]
        boards = [Dashboard(picture_of(chain), [live]) for live in lives]
        try:
            arrivals = while_in_contact(run)
            for board in boards:
                offered(board, arrivals)
            for live in lives:  # all that is to be seen came before
                with headless_viewer(live=live) as late:
                    still_at(late, 9_900 * MS)
                    check_views(late, 2)
            assert [board.dropped_batches for board in boards] == [0, 0]
        finally:
            for board in boards:
                board.close()

    retried(attempt)


def test_a_viewer_that_stands_still_holds_up_nobody(run: Any, chain: Chain) -> None:
    """Through a real viewer that is stopped; what a sink that blocks does, test_dashboard tells."""
    live = LiveServer(free_port())
    board = Dashboard(picture_of(chain), [live], queue_batches=50)
    with ExitStack() as stack:
        stack.callback(board.close)
        before = set(psutil.Process().children())
        client = stack.enter_context(headless_viewer(320, 180, live=live))
        (viewer,) = set(psutil.Process().children()) - before
        batches = run.batches(PASSAGES_NS)
        offered(board, batches[:60])
        wait_for(lambda: end_ns(client) > 1_000 * MS)
        stack.callback(viewer.send_signal, signal.SIGCONT)
        viewer.send_signal(signal.SIGSTOP)
        worst_s, rounds = 0.0, 0
        for rounds in range(1, 4):
            for batch, arrival_ns in batches:
                again = replace(batch, epoch=1 + rounds)
                began_s = time.monotonic()
                board.offer(again, arrival_ns + rounds * 12_000 * MS)
                worst_s = max(worst_s, time.monotonic() - began_s)
            time.sleep(0.5)
        # A machine too busy to run this thread is no viewer that holds it up.
        assert worst_s < 1.0
        viewer.send_signal(signal.SIGCONT)
        wait_for(lambda: board.waiting_batches == 0)
        newest_ns = rounds * 12_000 * MS
        wait_for(lambda: end_ns(client) > newest_ns)
