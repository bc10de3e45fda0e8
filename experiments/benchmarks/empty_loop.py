"""A loop that does nothing, on the sites' clock and with their real-time settings.

`python -m experiments.benchmarks.empty_loop RATE_HZ SECONDS` prints how late every tick was.
"""

import json
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.benchmarks.figures import BenchmarkError
from site_runtime.clock import Pacer, SteadyClock
from site_runtime.real_time import RealTimeSettings, apply_real_time


@dataclass(frozen=True, slots=True)
class Loop:
    """What a loop went through: how late it woke (n,) [ns], and how many ticks it missed."""

    lateness_ns: npt.NDArray[np.int64]
    missed: int

    @property
    def missed_share(self) -> float:
        """Missed of all ticks that were due."""
        return self.missed / (self.missed + len(self.lateness_ns))


def empty_loops(rate_hz: int, seconds: float, loops: int) -> list[Loop]:
    """Run so many at once, a process each; BenchmarkError if one fails."""
    command = [sys.executable, "-m", __name__, str(rate_hz), str(seconds)]
    processes = [
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)  # noqa: S603
        for _ in range(loops)
    ]
    found = []
    try:
        for process in processes:
            printed, _ = process.communicate()
            if process.returncode != 0:
                raise BenchmarkError(f"the empty loop ended with code {process.returncode}")
            told = json.loads(printed)
            found.append(Loop(np.array(told["lateness_ns"], dtype=np.int64), told["missed"]))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    return found


def main(rate_hz: int, seconds: float) -> None:
    """Run it and print."""
    clock = SteadyClock()
    lateness_ns = []
    with apply_real_time(RealTimeSettings("try")):
        pacer = Pacer(clock, round(1e9 / rate_hz))
        end_ns = clock.now_ns() + round(seconds * 1e9)
        while clock.now_ns() < end_ns:
            lateness_ns.append(pacer.wait())
    sys.stdout.write(json.dumps({"lateness_ns": lateness_ns, "missed": pacer.missed}))


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
