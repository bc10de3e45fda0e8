"""cyclictest, or a few lines of C in its place: how late a thread wakes that only sleeps."""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt

from experiments.benchmarks.figures import BenchmarkError

_WORST_NS = 10_000_000  # what is later counts as so late
_START_S = 30.0
_SOURCE = r"""
#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

int main(int count, char **arguments)
{
    if (count != 4) return 2;
    long interval_ns = atol(arguments[1]), cycles = atol(arguments[2]);
    struct sched_param parameters = {.sched_priority = atoi(arguments[3])};
    long *late_ns = calloc(cycles, sizeof *late_ns);
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    if (parameters.sched_priority && sched_setscheduler(0, SCHED_FIFO, &parameters)) return 3;
    struct timespec due, now;
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (long i = 0; i < cycles; i++) {
        due.tv_nsec += interval_ns;
        while (due.tv_nsec >= 1000000000) { due.tv_nsec -= 1000000000; due.tv_sec++; }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, 0);
        clock_gettime(CLOCK_MONOTONIC, &now);
        late_ns[i] = (now.tv_sec - due.tv_sec) * 1000000000 + now.tv_nsec - due.tv_nsec;
    }
    for (long i = 0; i < cycles; i++) printf("%ld\n", late_ns[i]);
    return 0;
}
"""


@dataclass(frozen=True, slots=True)
class Policy:
    """How a thread is scheduled; priority 0 is that of no real-time policy."""

    priority: int

    @classmethod
    def of(cls, pid: int) -> "Policy":
        """Return that of a process's first thread."""
        real_time = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        return cls(os.sched_getparam(pid).sched_priority if real_time else 0)

    def __str__(self) -> str:
        return f"SCHED_FIFO {self.priority}" if self.priority else "SCHED_OTHER"


class Sleeper:
    """The yardstick; within `with` it is ready to be run."""

    def __init__(self) -> None:
        self._cyclictest = shutil.which("cyclictest")
        self._compiler = shutil.which("cc")
        self.name = "cyclictest" if self._cyclictest else "a C loop (no cyclictest here)"

    def __enter__(self) -> "Sleeper":
        if self._cyclictest is None and self._compiler is None:
            raise BenchmarkError(
                "needs cyclictest (Debian's rt-tests), or a C compiler for its stand-in"
            )
        self._folder = TemporaryDirectory(prefix="farhand-bench-")
        if self._cyclictest is None and self._compiler is not None:
            source = self._program.with_suffix(".c")
            source.write_text(_SOURCE, encoding="utf-8")
            _run([self._compiler, "-O2", "-o", str(self._program), str(source)], 0.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def lateness_ns(
        self, interval_ns: int, seconds: float, policy: Policy
    ) -> npt.NDArray[np.float64]:
        """Return how late one thread woke (n,) [ns], in no order."""
        cycles = max(round(seconds * 1e9 / interval_ns), 1)
        if self._cyclictest is None:
            numbers = (interval_ns, cycles, policy.priority)
            told = _run([str(self._program), *map(str, numbers)], seconds)
            return np.array(told.split(), dtype=np.float64)
        out = Path(self._folder.name) / "cyclictest.json"
        how = ["--policy=fifo", "-p", str(policy.priority)] if policy.priority else []
        interval_us = max(round(interval_ns / 1000), 1)
        _run(
            [
                *(self._cyclictest, "--quiet", "--nsecs", "--mlockall", "--default-system"),
                *(*how, "-t", "1", "-i", str(interval_us), "-l", str(cycles)),
                *("-h", str(_WORST_NS), f"--json={out}"),
            ],
            seconds,
        )
        return _samples(json.loads(out.read_text(encoding="utf-8")))

    @property
    def _program(self) -> Path:
        return Path(self._folder.name) / "sleeper"


def _samples(
    told: dict[str, dict[str, dict[str, dict[str, int] | int]]],
) -> npt.NDArray[np.float64]:
    thread = told["thread"]["0"]
    histogram, cycles = thread["histogram"], thread["cycles"]
    assert isinstance(histogram, dict)  # noqa: S101 - by cyclictest's format
    assert isinstance(cycles, int)  # noqa: S101
    values = np.repeat([float(late) for late in histogram], list(histogram.values()))
    return np.concatenate((values, np.full(max(cycles - len(values), 0), float(_WORST_NS))))


def _run(command: Sequence[str], seconds: float) -> str:
    try:
        done = subprocess.run(  # noqa: S603 - cyclictest or our own program
            command, capture_output=True, text=True, timeout=seconds + _START_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchmarkError(f"{command[0]}: {error}") from error
    if done.returncode != 0:
        raise BenchmarkError(f"{command[0]} ended with {done.returncode}: {done.stderr.strip()}")
    return done.stdout
