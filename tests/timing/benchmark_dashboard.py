"""How old is what the dashboard shows? `python -m tests.timing.benchmark_dashboard`.

Runs both sites of a session, `farhand dashboard`, and a viewer without a window, all on this
machine. At random moments it asks the viewer for the time of the newest row it has, and compares
that row's stamp with the clock: what a person sees is as old, and one frame of the screen more.
Then, without a viewer, the processor time and the memory of the dashboard's process.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import psutil
from rerun.experimental import ViewerClient

from farhand.feed import Feed
from site_runtime.keys import SiteId
from site_runtime.session import Session, load_session
from telemetry.dashboard import LiveServer, free_port, headless_viewer

SETTLE_S = 8.0


@contextmanager
def processes(path: Path, endpoints: dict[SiteId, str], live: LiveServer) -> Iterator[int]:
    """Both sites and the dashboard; the dashboard's process id."""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    remote, local = endpoints[SiteId.REMOTE], endpoints[SiteId.LOCAL]
    commands = [
        ["remote_site", str(path), "--quiet", "--listen", remote],
        ["local_site", str(path), "--quiet", "--listen", local, "--connect", remote],
        [
            *("farhand", "dashboard", str(path), "--connect", remote, "--connect", local),
            *("--port", str(live.port), "--web-port", str(free_port())),
        ],
    ]
    started = []
    try:
        for command in commands:
            started.append(
                subprocess.Popen(
                    [sys.executable, "-m", *command],
                    env=environment,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        yield started[-1].pid
    finally:
        for process, how in zip(
            started, (signal.SIGTERM, signal.SIGTERM, signal.SIGINT), strict=False
        ):
            process.send_signal(how)
        for process in started:
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()


def session_start_ns(session: Session, endpoints: dict[SiteId, str]) -> int:
    """Session time zero on this machine's monotonic clock, which the sites' stamps are of."""
    with closing(Feed(session, list(endpoints.values()))) as feed:
        while True:
            for batch, _ in feed.receive():
                return int(batch.rows["stamp_ns"][-1] - batch.rows["time_ns"][-1])
            time.sleep(0.01)


def age_ms(viewer: ViewerClient, start_ns: int) -> float:
    """Age of the newest row that the viewer has, at the middle of the call that asks."""
    before_ns = time.monotonic_ns()
    state = viewer.get_state()
    now_ns = (before_ns + time.monotonic_ns()) / 2
    ends = [t.end or 0 for r in state.recordings for t in r.timelines if t.name == "t"]
    return (now_ns - start_ns - max(ends, default=0)) * 1e-6


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("session", type=Path, nargs="?", default=Path("experiments/demo.toml"))
    arguments.add_argument("--seconds", type=float, default=30.0)
    given = arguments.parse_args()
    session, random = load_session(given.session), np.random.default_rng(1)
    endpoints = {site: f"tcp/127.0.0.1:{free_port()}" for site in SiteId}
    live = LiveServer(free_port())
    with processes(given.session, endpoints, live) as pid:
        board = psutil.Process(pid)
        time.sleep(SETTLE_S)
        start_ns = session_start_ns(session, endpoints)
        with headless_viewer(320, 180, live=live) as viewer:
            time.sleep(SETTLE_S / 2)
            ages_ms = []
            end_s = time.monotonic() + given.seconds
            while time.monotonic() < end_s:
                ages_ms.append(age_ms(viewer, start_ns))
                time.sleep(random.uniform(0.05, 0.25))
        times, began_s = board.cpu_times(), time.monotonic()
        resident_mb = board.memory_info().rss * 1e-6
        time.sleep(given.seconds)
        used_s = sum(board.cpu_times()[:2]) - sum(times[:2])
        share = used_s / (time.monotonic() - began_s)
        grown_mb = board.memory_info().rss * 1e-6 - resident_mb
    p50, p90, p99 = np.percentile(ages_ms, [50, 90, 99])
    print(f"load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")  # noqa: T201
    print(  # noqa: T201
        f"newest row in the viewer, of {len(ages_ms)} looks: p50 {p50:.0f}, p90 {p90:.0f}, "
        f"p99 {p99:.0f}, worst {max(ages_ms):.0f} ms old"
    )
    print(  # noqa: T201
        f"dashboard's process: {share:.1%} of a core, {resident_mb:.0f} MB, "
        f"{grown_mb:+.0f} MB in {given.seconds:.0f} s"
    )


if __name__ == "__main__":
    main()
