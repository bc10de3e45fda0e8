"""What telemetry, recording and metrics add to a tick.

Three pairs of the demo's sites tick side by side in this process, in turns of fifty ticks:
one tells nothing (no row, no arrival), one tells into memory of its own, and one into memory that a
flight recorder and a metrics process read. Timed is the remote site's tick without its plant, on a
clock turned by hand, packets by memory; ticks are paced, cold as a daemon's are.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from tempfile import TemporaryDirectory

import numpy as np

from channel.memory_link import memory_links
from experiments.benchmarks.figures import Benchmark, BenchmarkError, Effort, Goal, Row, Spread
from experiments.benchmarks.sites import DEMO
from experiments.benchmarks.tick import TimedDevice
from hardware.interface import Device, FloatArray
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock, Pacer, SteadyClock
from site_runtime.flight_recorder import start_recorder
from site_runtime.metrics import MetricsAddress, start_metrics
from site_runtime.session import Session, load_session
from site_runtime.supervisor import State
from telemetry.companion import SharedMemory
from telemetry.row_ring import Memory

TURN_TICKS = 50
_WARM_UP_TICKS = 2000


class Pair:
    """Both sites of the demo on one clock turned by hand; times the remote site's ticks."""

    def __init__(self, session: Session, allocate: Callable[[int], Memory] = bytearray) -> None:
        self._period_ns = session.period_ns
        self._clock = ManualClock()
        self._watched: list[TimedDevice] = []
        local_link, remote_link = memory_links()
        common = (self._clock, 0)
        self.local = build_local_site(session, Surroundings(local_link, *common, 1, lambda _: None))
        self.remote = build_remote_site(
            session,
            Surroundings(
                remote_link,
                *common,
                2,
                lambda _: None,
                allocate=allocate,
                in_place_of=self._watch,
            ),
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
        (device,) = self._watched
        device.spent_ns = 0
        begin_ns = time.perf_counter_ns()
        self.remote.tick()
        self.remote.telemetry.flush()
        self.took_ns.append(time.perf_counter_ns() - begin_ns - device.spent_ns)

    def _watch(self, device: Device) -> Device:
        self._watched.append(TimedDevice(device))
        return self._watched[0]


def measure(effort: Effort) -> Iterator[Row]:
    """Let the three pairs tick in turns."""
    turns = max(round(effort.seconds * 1e3 / TURN_TICKS / 3), 1)
    session = load_session(DEMO)
    with TemporaryDirectory(prefix="farhand-bench-") as folder, ExitStack() as stack:
        session = replace(session, recorder=replace(session.recorder, directory=folder))
        silent, own = Pair(session), Pair(session)
        silent.silence()
        read = stack.enter_context(_read_by_others(session))
        pairs = (silent, own, read)
        pacer = Pacer(SteadyClock(), session.period_ns)
        for _ in range(_WARM_UP_TICKS):
            for pair in pairs:
                pair.tick()
        for pair in pairs:
            pair.took_ns.clear()
        for _ in range(turns):
            for pair in pairs:
                for _ in range(TURN_TICKS):
                    pacer.wait()
                    pair.tick()
    _check(silent, own, read)
    without, into_own, with_all = (np.array(pair.took_ns) * 1e-3 for pair in pairs)
    yield Row(
        what="a tick with telemetry, recording and metrics, its plant excluded, cold at 1 kHz",
        against="the tick that tells nothing",
        unit="µs",
        ours=Spread.of(with_all),
        yardstick=Spread.of(without),
        goals=(Goal("added to p50, %", added_percent(with_all, without), 10.0, 3.0),),
        notes=(
            f"what is added is the median of {turns} neighbouring turns; a row into the site's own "
            f"memory alone adds {added_percent(into_own, without):.1f} %",
        ),
    )


def added_percent(took_us: FloatArray, without_us: FloatArray) -> float:
    """Return the median over the turns, neighbour by neighbour, of what the median tick gained."""
    ours, yardstick = (
        np.median(each.reshape(-1, TURN_TICKS), axis=1) for each in (took_us, without_us)
    )
    return 100.0 * float(np.median(ours / yardstick) - 1.0)


def _check(silent: Pair, *telling: Pair) -> None:
    """See that the pairs did what they stand for."""
    if silent.remote.telemetry.count or not all(pair.remote.telemetry.count for pair in telling):
        raise BenchmarkError("the silent site is not silent, or another is")
    states = [pair.remote.state for pair in (silent, *telling)]
    if states != [State.ENGAGED] * len(states):
        raise BenchmarkError(f"not all sites are engaged: {states}")


@contextmanager
def _read_by_others(session: Session) -> Iterator[Pair]:
    """Yield a pair whose remote site is recorded and measured by processes of their own."""
    with ExitStack() as stack:
        memory = SharedMemory()
        stack.callback(memory.close)
        pair = Pair(session, memory.allocate)
        address = MetricsAddress("127.0.0.1", 0)
        stack.enter_context(start_metrics(session, pair.remote, memory, address, recorded=True))
        stack.enter_context(start_recorder(session, pair.remote, memory))
        yield pair


TELEMETRY = Benchmark("telemetry", "what telemetry, recording and metrics add to a tick", measure)
