"""Memory and processor time of processes, from /proc."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from experiments.benchmarks.figures import BenchmarkError

_TICKS_HZ = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Usage:
    """Processor time since the start [s] and memory in use [bytes], of some processes together."""

    cpu_s: float
    resident_bytes: int


def usage_of(pids: Iterable[int]) -> Usage:
    """Return what these processes have used; BenchmarkError if one is gone."""
    cpu_ticks = pages = 0
    for pid in pids:
        try:
            # after the name, which may hold spaces; see proc_pid_stat(5)
            fields = (
                Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            )
        except OSError as error:
            raise BenchmarkError(f"process {pid} is gone") from error
        cpu_ticks += int(fields[11]) + int(fields[12])
        pages += int(fields[21])
    return Usage(cpu_ticks / _TICKS_HZ, pages * _PAGE_BYTES)


def family(pid: int) -> list[int]:
    """Return a process and those that it, and they, have started."""
    found = [pid]
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in thread.read_text(encoding="utf-8").split():
            found += family(int(child))
    return found
