"""Read and write latencies of the Quanser driver on the fake board, under a 1 kHz loop.

    python -m tests.timing.benchmark_quanser [--seconds S] [--busy PROCESSES]

Compares two ways to read: the driver's (a thread fetches what the board's clock samples, `read`
takes the newest) and asking the board in every tick, differences taken between the ticks. The fake
answers at once, or after 0.2 ms, a guess at a USB board's round trip: how long a real one takes is
not known here.
"""

import argparse
import multiprocessing
import time
from collections.abc import Callable

import numpy as np

from hardware.quanser import QuanserDevice
from hardware.quanser_board import QuanserBoard
from site_runtime.real_time import RealTimeSettings, apply_real_time
from tests.fakes import quanser_hardware as fake
from tests.fakes.quanser_bench import settings_of

PERIOD_NS = 1_000_000
WORK_NS = 400_000  # of Python in every tick, as much as a site's
SPEED_RAD_S = 0.5


class Turning:
    """Joints that turn steadily, whatever is done to them."""

    def __init__(self) -> None:
        self._angle = 0.0

    def angle_rad(self) -> list[float]:
        return [self._angle] * 2

    def push(self, torque_nm: list[float], from_ns: int, to_ns: int) -> None:
        self._angle += SPEED_RAD_S * (to_ns - from_ns) * 1e-9


def loop(
    seconds: float,
    read: Callable[[], tuple[float, int]],
    write: Callable[[], None],
) -> dict[str, np.ndarray]:
    """Run a 1 kHz loop; return latencies, ages [µs] and velocities [rad/s]."""
    ticks = round(seconds * 1e3)
    rows = np.empty((ticks, 4))
    deadline_ns = time.monotonic_ns()
    for tick in range(ticks):
        deadline_ns = max(deadline_ns + PERIOD_NS, time.monotonic_ns() - PERIOD_NS)
        time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
        start_ns = time.monotonic_ns()
        velocity, stamp_ns = read()
        read_ns = time.monotonic_ns()
        while time.monotonic_ns() < read_ns + WORK_NS:
            pass
        write_ns = time.monotonic_ns()
        write()
        end_ns = time.monotonic_ns()
        rows[tick] = read_ns - start_ns, end_ns - write_ns, read_ns - stamp_ns, velocity
    rows = rows[min(200, ticks // 2) :]
    return {
        "read [µs]": rows[:, 0] / 1e3,
        "write [µs]": rows[:, 1] / 1e3,
        "age of the sample [µs]": rows[:, 2] / 1e3,
        "error of velocity [rad/s]": np.abs(rows[:, 3] - SPEED_RAD_S),
    }


def with_thread(seconds: float, bus_s: float) -> dict[str, np.ndarray]:
    robot = fake.Robot(counts_per_rad=(1e6, 1e6), encoder_signs=(1, 1))
    fake.connect(fake.Board(robot, Turning(), bus_s=bus_s))
    settings = settings_of(robot, watchdog_s=0.1, drive_matrix=((1.0, 0.0), (0.0, 1.0)))
    device = QuanserDevice(settings, time.monotonic_ns)
    device.open()
    device.enable()
    torque = np.full(2, 0.01)

    def read() -> tuple[float, int]:
        state = device.read()
        return float(state.velocity_rad_s[0]), state.stamp_ns

    found = loop(seconds, read, lambda: device.write(torque))
    device.close()
    return found


def by_asking(seconds: float, bus_s: float) -> dict[str, np.ndarray]:
    robot = fake.Robot(counts_per_rad=(1e6, 1e6), encoder_signs=(1, 1))
    fake.connect(fake.Board(robot, Turning(), bus_s=bus_s))
    board = QuanserBoard(settings_of(robot).wiring)
    board.open()
    board.arm(5.0)
    rad_per_count = 1.0 / np.array(robot.counts_per_rad)
    angle, velocity, stamp_ns = board.read_counts() * rad_per_count, np.zeros(2), 0

    def read() -> tuple[float, int]:
        nonlocal angle, velocity, stamp_ns
        now = board.read_counts() * rad_per_count
        now_ns = time.monotonic_ns()
        elapsed_s = (now_ns - stamp_ns) * 1e-9
        velocity = velocity + elapsed_s / (elapsed_s + 0.0038) * (
            (now - angle) / elapsed_s - velocity
        )
        angle, stamp_ns = now, now_ns
        return float(velocity[0]), now_ns

    found = loop(seconds, read, lambda: board.write_volts([0.01, 0.01]))
    board.make_safe()
    board.close()
    return found


def burn() -> None:
    while True:
        pass


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--busy", type=int, default=0)
    options = parser.parse_args()
    burners = [multiprocessing.Process(target=burn, daemon=True) for _ in range(options.busy)]
    for burner in burners:
        burner.start()
    with apply_real_time(RealTimeSettings(), None) as real_time:
        print(f"real time refused: {list(real_time.refused)}")  # noqa: T201
        for name, way in (("thread", with_thread), ("asking", by_asking)):
            for bus_s in (0.0, 2e-4):
                print(f"{name}, the board answers after {bus_s * 1e3:g} ms, {options.busy} busy")  # noqa: T201
                for what, values in way(options.seconds, bus_s).items():
                    p50, p99 = np.percentile(values, (50, 99))
                    print(f"  {what:28} p50 {p50:9.3g}  p99 {p99:9.3g}  worst {values.max():9.3g}")  # noqa: T201
    for burner in burners:
        burner.terminate()


if __name__ == "__main__":
    main()
