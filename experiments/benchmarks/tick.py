"""One tick of the remote site beside its floor: pinocchio's calls and one Zenoh put.

    python -m experiments.benchmarks.tick [--seconds S]

The demo's remote site, with an arm of four links and a second sub-task, ticks at its rate; packets
come and go by Zenoh over loopback, the local site's end in a session of its own. Every period does
both, tick and floor. The one whose turn it is comes first, right after the sleep, and is timed; the
other follows untimed, so that both are as cold as in a daemon. Turns change every quarter of a
second. What the plant takes is subtracted from the tick; before the floor a plant is computed too,
untimed, as it leaves pinocchio's code in the caches.
"""

import argparse
import gc
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path

import numpy as np

from channel.zenoh_link import ZenohLink, ZenohNode, ZenohSettings
from hardware.interface import Device, DeviceState, FloatArray, JointStops
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import Pacer, SteadyClock
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import Session, parse_session
from site_runtime.session_edit import TomlValue, edited
from site_runtime.supervisor import State

DEMO = Path(__file__).parents[1] / "demo.toml"
TURN_TICKS = 250
WARM_UP_TICKS = 2000
PACKET = bytes(137)
POSE_RAD = [1.722036, -0.531499, -1.2633, -1.142662]  # its point is the local one
FOUR_LINKS: dict[str, TomlValue] = {
    "remote.robot": {
        "kind": "planar",
        "lengths_m": [0.285] * 4,
        "masses_kg": [0.225] * 4,
    },
    "remote.device.initial_position_rad": POSE_RAD,
    "remote.damping.joint_nm_s": [0.2] * 4,
    "remote.limits.torque_nm": [20.0] * 4,
    "remote.limits.velocity_rad_s": [8.0] * 4,
    "remote.sub_tasks": [
        {"kind": "obstacle", "gain": 1500.0},
        {"kind": "manipulability", "gain": 2.0},
    ],
}
"""The demo's remote arm with four joints instead of three, of the same length and mass."""


@dataclass(frozen=True, slots=True)
class TickFigures:
    """Percentiles 50, 99, 99.9 (3,) [µs] of the tick without its plant, and of the floor."""

    tick_us: FloatArray
    floor_us: FloatArray
    ticks: int
    missed: int

    @property
    def ratios(self) -> FloatArray:
        """Tick over floor, percentile by percentile, (3,)."""
        return self.tick_us / self.floor_us


class TimedDevice:
    """A device that adds up how long its plant takes in `spent_ns`."""

    def __init__(self, device: Device) -> None:
        self.spent_ns = 0
        self.joints = device.joints
        self._device = device
        self.open, self.enable = device.open, device.enable
        self.stop, self.close = device.stop, device.close

    @property
    def joint_stops(self) -> JointStops:
        """Those of the device."""
        return self._device.joint_stops

    def read(self) -> DeviceState:
        """Return the newest state."""
        begin_ns = time.perf_counter_ns()
        state = self._device.read()
        self.spent_ns += time.perf_counter_ns() - begin_ns
        return state

    def write(self, torque_nm: FloatArray) -> None:
        """Command joint torques (n,) [N·m]."""
        begin_ns = time.perf_counter_ns()
        self._device.write(torque_nm)
        self.spent_ns += time.perf_counter_ns() - begin_ns


class Bench:
    """Both sites over Zenoh, and the remote site's floor beside them."""

    def __init__(self, session: Session, local: ZenohNode, remote: ZenohNode) -> None:
        clock = SteadyClock()
        nodes = {SiteId.LOCAL: local, SiteId.REMOTE: remote}
        surroundings = {
            site: Surroundings(
                node.link(f"bench/{site.label}", f"bench/{site.peer.label}"),
                clock,
                clock.now_ns(),
                1 + site,
                node.publisher(f"bench/{site.label}/telemetry"),
            )
            for site, node in nodes.items()
        }
        self.local = build_local_site(session, surroundings[SiteId.LOCAL])
        self.remote = build_remote_site(
            session, replace(surroundings[SiteId.REMOTE], in_place_of=self._watch)
        )
        self._robot = robot_of(session, SiteId.REMOTE)
        self._q, self._q_dot = np.array(POSE_RAD), np.full(len(POSE_RAD), 0.1)
        self._link: ZenohLink = remote.link("bench/floor", "bench/nobody")
        self._heard = local.subscriber("bench/floor", 64)

    def _watch(self, device: Device) -> Device:
        self._watched: TimedDevice = TimedDevice(device)
        return self._watched

    def tick(self) -> int:
        """Let the remote site tick; return what it took [ns], the plant left out."""
        device = self._watched
        device.spent_ns = 0
        begin_ns = time.perf_counter_ns()
        self.remote.tick()
        took_ns = time.perf_counter_ns() - begin_ns
        return took_ns - device.spent_ns

    def floor(self) -> int:
        """Call pinocchio as a tick does, and put a packet; return what it took [ns]."""
        robot, q, q_dot = self._robot, self._q, self._q_dot
        robot.end_effector(q, q_dot)
        robot.forward_dynamics(q, q_dot, q_dot)
        begin_ns = time.perf_counter_ns()
        robot.compute(q, q_dot)
        self._link.send(PACKET)
        return time.perf_counter_ns() - begin_ns

    def others(self) -> None:
        """Do what is not timed: the peer's tick, both sites' telemetry."""
        self.remote.telemetry.flush()
        self.local.tick()
        self.local.telemetry.flush()
        self._heard.receive()

    def close(self) -> None:
        """Stop both robots."""
        self.remote.close()
        self.local.close()


def tick_figures(seconds: float = 20.0) -> TickFigures:
    """Measure for so long [s], turn by turn; RuntimeError if the sites did not stay engaged."""
    session = parse_session(edited(DEMO.read_text(encoding="utf-8"), FOUR_LINKS), DEMO)
    tick_ns: list[int] = []
    floor_ns: list[int] = []
    with _bench(session) as bench, _no_collector():
        turns = cycle((tick_ns, floor_ns))
        pacer = Pacer(SteadyClock(), session.period_ns)
        for _ in range(WARM_UP_TICKS):
            pacer.wait()
            bench.tick()
            bench.floor()
            bench.others()
        missed_before = pacer.missed
        for number in range(round(seconds * session.loop.rate_hz)):
            if number % TURN_TICKS == 0:
                turn = next(turns)
            pacer.wait()
            if turn is tick_ns:
                took_ns = bench.tick()
                bench.floor()
            else:
                took_ns = bench.floor()
                bench.tick()
            bench.others()
            if bench.remote.state is State.ENGAGED:
                turn.append(took_ns)
        missed = pacer.missed - missed_before
    if len(tick_ns) < 0.4 * seconds * session.loop.rate_hz:
        raise RuntimeError(f"the remote site is {bench.remote.state.name}: {bench.remote.cause}")
    tick_us, floor_us = (1e-3 * np.percentile(took, (50, 99, 99.9)) for took in (tick_ns, floor_ns))
    return TickFigures(tick_us, floor_us, len(tick_ns), missed)


@contextmanager
def _bench(session: Session) -> Iterator[Bench]:
    """Both sites open, met over a port that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with (
        closing(ZenohNode(ZenohSettings(listen=(endpoint,)))) as remote,
        closing(ZenohNode(ZenohSettings(connect=(endpoint,)))) as local,
        closing(Bench(session, local, remote)) as bench,
    ):
        bench.remote.open()
        bench.local.open()
        yield bench


@contextmanager
def _no_collector() -> Iterator[None]:
    """As in a daemon: the garbage collector is off."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    figures = tick_figures(parser.parse_args().seconds)
    print(f"{'[µs]':6} {'p50':>8} {'p99':>8} {'p99.9':>8}")  # noqa: T201
    for name, values in (("tick", figures.tick_us), ("floor", figures.floor_us)):
        print(f"{name:6} " + " ".join(f"{value:8.1f}" for value in values))  # noqa: T201
    print("ratio  " + " ".join(f"{value:8.2f}" for value in figures.ratios))  # noqa: T201
    print(f"{figures.ticks} ticks timed, {figures.missed} missed")  # noqa: T201


if __name__ == "__main__":
    main()
