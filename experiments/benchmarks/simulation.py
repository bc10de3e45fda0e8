"""`farhand simulate` on one core, beside the same session hand-written on numpy and MuJoCo."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median

_START_ONLY_S = 0.001
_SIMULATE = ("-m", "farhand", "simulate")
_BY_HAND = ("-m", "experiments.benchmarks.mujoco_loop")


@dataclass(frozen=True, slots=True)
class SimulationFigures:
    """CPU time [s] of whole processes, a pair a turn, and of their start alone.

    A process reads the session file, simulates `duration_s` and keeps all samples in memory.
    """

    session: str
    duration_s: float
    farhand_s: tuple[float, ...]
    by_hand_s: tuple[float, ...]
    farhand_start_s: tuple[float, ...]
    by_hand_start_s: tuple[float, ...]

    @property
    def farhand_s_per_s(self) -> tuple[float, ...]:
        """CPU time of one session second, start excluded, a turn each."""
        return _per_second(self.farhand_s, self.farhand_start_s, self.duration_s)

    @property
    def by_hand_s_per_s(self) -> tuple[float, ...]:
        """The same of the MuJoCo loop."""
        return _per_second(self.by_hand_s, self.by_hand_start_s, self.duration_s)

    @property
    def times_real_time(self) -> float:
        """Session seconds in a second of one core, start included: what a user waits for."""
        return self.duration_s / median(self.farhand_s)

    @property
    def by_hand_times_real_time(self) -> float:
        """The same of the MuJoCo loop."""
        return self.duration_s / median(self.by_hand_s)

    @property
    def ratio(self) -> float:
        """What farhand takes over what the MuJoCo loop takes, start excluded; in the median."""
        pairs = zip(self.farhand_s_per_s, self.by_hand_s_per_s, strict=True)
        return median(ours / theirs for ours, theirs in pairs)


def simulation_figures(
    session: Path, duration_s: float = 60.0, turns: int = 5
) -> SimulationFigures:
    """Run both in turns, each in a process of its own, all on one core.

    Raises RuntimeError without MuJoCo, and if a process fails.
    """
    if find_spec("mujoco") is None:
        raise RuntimeError("needs mujoco: pip install mujoco")
    farhand_s, by_hand_s, farhand_start_s, by_hand_start_s = [], [], [], []
    with _one_core():
        for _ in range(turns):
            farhand_start_s.append(_cpu_s(_SIMULATE, session, _START_ONLY_S))
            by_hand_start_s.append(_cpu_s(_BY_HAND, session, _START_ONLY_S))
            farhand_s.append(_cpu_s(_SIMULATE, session, duration_s))
            by_hand_s.append(_cpu_s(_BY_HAND, session, duration_s))
    return SimulationFigures(
        session.stem,
        duration_s,
        tuple(farhand_s),
        tuple(by_hand_s),
        tuple(farhand_start_s),
        tuple(by_hand_start_s),
    )


def _per_second(
    whole_s: Sequence[float], start_s: Sequence[float], duration_s: float
) -> tuple[float, ...]:
    pairs = zip(whole_s, start_s, strict=True)
    return tuple((whole - start) / (duration_s - _START_ONLY_S) for whole, start in pairs)


def _cpu_s(program: Sequence[str], session: Path, duration_s: float) -> float:
    """Return the processor time of one process [s]."""
    command = [sys.executable, *program, str(session), "--duration", str(duration_s)]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(  # noqa: S603 - ourselves
            command, stdout=said, stderr=subprocess.STDOUT, env=_environment()
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode != 0:
            said.seek(0)
            raise RuntimeError(f"{' '.join(command)}: {said.read().decode(errors='replace')}")
    return used.ru_utime + used.ru_stime


def _environment() -> dict[str, str]:
    """Name the places this process imports from: a process elsewhere measures the same code."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@contextmanager
def _one_core() -> Iterator[None]:
    """Keep this thread, and with it the processes it starts, on one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
