"""What telemetry, recording and metrics add to a tick.

    python -m tests.timing.benchmark_telemetry [--ticks N] [--rate HZ]

Three pairs of the demo's sites tick side by side in this process, in turns of some hundred ticks:
one tells nothing (no row, no arrival), one tells into memory of its own, and one into memory that a
flight recorder and a metrics process read. Timed is the remote site's tick, on a clock turned by
hand, its plant in it, packets by memory. With a rate, ticks are paced, cold as a daemon's are.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from channel.memory_link import memory_links
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.flight_recorder import start_recorder
from site_runtime.metrics import MetricsAddress, start_metrics
from site_runtime.session import Session, load_session
from site_runtime.site import Site
from telemetry.companion import SharedMemory
from telemetry.row_ring import Memory

DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"
TURN_TICKS = 200
WARM_UP_TICKS = 2000


class Pair:
    """Both sites of the demo on one clock turned by hand; counts the remote site's ticks."""

    def __init__(self, session: Session, allocate: Callable[[int], Memory] = bytearray) -> None:
        self._period_ns = session.period_ns
        self._clock = ManualClock()
        local_link, remote_link = memory_links()
        common = (self._clock, 0)
        self.local = build_local_site(session, Surroundings(local_link, *common, 1, lambda _: None))
        self.remote = build_remote_site(
            session, Surroundings(remote_link, *common, 2, lambda _: None, allocate=allocate)
        )
        for site in (self.local, self.remote):
            site.open()
        self.took_ns: list[int] = []

    def silence(self) -> None:
        """Let the remote site tell nothing."""
        nothing: Callable[..., None] = lambda *_, **__: None  # noqa: E731
        stream = self.remote.telemetry
        stream.put = stream.flush = stream.event = nothing  # type: ignore[method-assign]
        self.remote.channel._link = self.remote.channel._link._link  # type: ignore[attr-defined]
        self.remote._put = nothing  # type: ignore[method-assign]

    def tick(self) -> None:
        """Let a period pass and both sites tick."""
        self._clock.sleep_until_ns(self._clock.now_ns() + self._period_ns)
        self.local.tick()
        self.local.telemetry.flush()
        begin_ns = time.perf_counter_ns()
        self.remote.tick()
        self.remote.telemetry.flush()
        self.took_ns.append(time.perf_counter_ns() - begin_ns)


@contextmanager
def watched(session: Session) -> Iterator[Pair]:
    """A pair whose remote site is recorded and measured by processes of their own."""
    with ExitStack() as stack:
        memory = SharedMemory()
        stack.callback(memory.close)
        pair = Pair(session, memory.allocate)
        address = MetricsAddress("127.0.0.1", 0)
        site: Site = pair.remote
        stack.enter_context(start_metrics(session, site, memory, address, recorded=True))
        stack.enter_context(start_recorder(session, site, memory))
        yield pair


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--ticks", type=int, default=20_000, help="of each pair")
    parser.add_argument("--rate", type=float, default=0.0, help="ticks a second; 0: all at once")
    options = parser.parse_args()
    session = load_session(DEMO)
    with TemporaryDirectory(prefix="farhand-bench-") as folder, ExitStack() as stack:
        session = _recording_in(session, folder)
        silent, own = Pair(session), Pair(session)
        silent.silence()
        pairs = {
            "tells nothing": silent,
            "into its own memory": own,
            "into memory that two processes read": stack.enter_context(watched(session)),
        }
        for turn in range((WARM_UP_TICKS + options.ticks) // TURN_TICKS):
            for pair in pairs.values():
                for _ in range(TURN_TICKS):
                    if options.rate:
                        time.sleep(1.0 / options.rate)
                    pair.tick()
            if turn == WARM_UP_TICKS // TURN_TICKS - 1:
                for pair in pairs.values():
                    pair.took_ns.clear()
        rows = {name: np.array(pair.took_ns) * 1e-3 for name, pair in pairs.items()}
    base = np.percentile(rows["tells nothing"], (50, 99))
    print(f"{'remote tick [µs]':40} {'p50':>8} {'p99':>8}   of the one that tells nothing")  # noqa: T201
    for name, took_us in rows.items():
        p50, p99 = np.percentile(took_us, (50, 99))
        ratios = f"{p50 / base[0]:.3f}  {p99 / base[1]:.3f}"
        print(f"{name:40} {p50:8.1f} {p99:8.1f}   {ratios}")  # noqa: T201


def _recording_in(session: Session, folder: str) -> Session:
    return replace(session, recorder=replace(session.recorder, directory=folder))


if __name__ == "__main__":
    main()
