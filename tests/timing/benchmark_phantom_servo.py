"""Where should the PHANToM's servo callback live? `python -m tests.timing.benchmark_phantom_servo`.

Runs a 1 kHz loop that computes for half of every period, with the callback in a process of its
own (the driver) and as a thread of the loop's process, in turns, over the stand-in for libHD.
Prints how late the scheduler's thread woke, how long the callback took, and how old the reading was
on which the torque that left was based.
"""

import argparse
import json
import mmap
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import hardware.phantom
from hardware.phantom import PhantomDevice, PhantomSettings
from hardware.phantom_servo import Servo, ServoMemory, ServoOptions
from hardware.robot_model import PlanarArm, build_robot
from site_runtime.clock import Pacer, SteadyClock
from site_runtime.real_time import RealTimeSettings, apply_real_time
from tests.fakes.hd.fake_hd import LOG, FakeHd, LogEntry

CODE_US = 100_000  # a torque tells the microsecond of its reading, modulo this
MEASURES = ("wake-up late", "callback", "reading to torque", "reading at the site")


class ServoThread:
    """The servo loop in this process, in the place of ServoProcess."""

    alive = True

    def __init__(self, options: ServoOptions) -> None:
        self.memory = ServoMemory(mmap.mmap(-1, ServoMemory.SIZE))
        self._servo = Servo(options, self.memory)
        policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        if options.priority > 0:  # for the scheduler's thread to inherit
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(options.priority))
        self._servo.start()
        os.sched_setscheduler(0, policy, parameters)
        self.wait(lambda: self.memory.state.get()[0] != 0, 5.0)

    def wait(self, condition: Callable[[], Any], limit_s: float) -> bool:
        end_s = time.monotonic() + limit_s
        while not condition() and time.monotonic() < end_s:
            time.sleep(2e-4)
        return bool(condition())

    def end(self) -> None:
        self._servo.stop()


def measure(
    place: str, seconds: float, busy_ns: int, real_time: RealTimeSettings, out: Path
) -> None:
    """Run one loop; write the samples of every measure [µs]."""
    if place == "thread":
        hardware.phantom.ServoProcess = ServoThread  # type: ignore[misc, assignment]
    robot = build_robot(PlanarArm("planar", (0.21, 0.17), (0.2, 0.2)), None)
    clock = SteadyClock()
    fake = FakeHd()
    fake.block.inertia[:] = (1e3,) * 3
    settings = PhantomSettings(
        (0.0, 0.0),
        library=fake.library,
        device_name=fake.device_name,
        theta3="relative",
        torque_ramp_s=0.0,
        timeout_s=1.0,
    )
    with apply_real_time(real_time):
        device = PhantomDevice(settings)
        device.open()
        device.enable()
        pacer = Pacer(clock, 1_000_000)
        end_ns = clock.now_ns() + round(seconds * 1e9)
        reading_us = []
        first = fake.block.log_count + 100
        while clock.now_ns() < end_ns:
            pacer.wait()
            start_ns = clock.now_ns()
            state = device.read()
            reading_us.append((clock.now_ns() - state.stamp_ns) * 1e-3)
            while clock.now_ns() - start_ns < busy_ns:
                robot.terms(state.position_rad, state.velocity_rad_s)
            code = state.stamp_ns // 1000 % CODE_US
            device.write(np.array([code * 1e-6, 0.0]))
        last = fake.block.log_count - 2
        device.close()
    log = np.frombuffer(fake.block.log, dtype=np.dtype(LogEntry))
    log = log[np.arange(max(first, last - LOG + 10), last) % LOG]
    code = np.round(log["sent_mnm"][:, 1] * 1e3)
    np.savez(
        out,
        late=(log["start_ns"] - log["due_ns"]) * 1e-3,
        callback=(log["end_ns"] - log["start_ns"]) * 1e-3,
        torque=(log["end_ns"] // 1000 - code) % CODE_US,
        reading=np.array(reading_us),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--busy-ms", type=float, default=0.5)
    parser.add_argument("--real-time", choices=("try", "off"), default="off")
    parser.add_argument("--priority", type=int, default=80)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    busy_ns = round(options.busy_ms * 1e6)
    if options.one:
        place, out = options.one
        real_time = RealTimeSettings(options.real_time, options.priority)
        measure(place, options.seconds, busy_ns, real_time, Path(out))
        return
    pooled: dict[str, list[dict[str, Any]]] = {"process": [], "thread": []}
    with tempfile.TemporaryDirectory() as folder:
        for repeat in range(options.repeats):
            for place, runs in pooled.items():
                out = Path(folder) / f"{place}{repeat}.npz"
                subprocess.run(
                    [
                        *(sys.executable, "-m", "tests.timing.benchmark_phantom_servo"),
                        *sys.argv[1:],
                        *("--one", place, str(out)),
                    ],
                    check=True,
                )
                with np.load(out) as values:
                    runs.append(dict(values))
    print("| [µs] | callback lives in | p50 | p99 | p99.9 | worst | frames > 1 ms |")  # noqa: T201
    print("|---|---|---|---|---|---|---|")  # noqa: T201
    for name, key in zip(MEASURES, ("late", "callback", "torque", "reading"), strict=True):
        for place, runs in pooled.items():
            values = np.concatenate([run[key] for run in runs])
            spread = [f"{value:.0f}" for value in np.percentile(values, (50, 99, 99.9, 100))]
            print(  # noqa: T201
                f"| {name} | {place} | {' | '.join(spread)} | {np.mean(values > 1000):.2%} |"
            )
    print(json.dumps({place: sum(len(r["late"]) for r in runs) for place, runs in pooled.items()}))  # noqa: T201


if __name__ == "__main__":
    main()
