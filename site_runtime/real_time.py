"""Real-time settings of a daemon: asked for explicitly, and what the machine refuses is said.

`enforce` refuses to run without them, `try` runs with what it gets, `off` leaves the process as
it is, garbage collector included.
"""

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Literal, Self

from pydantic import Field

# linux/mman.h, linux/prctl.h, linux/capability.h
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
_CAP_IPC_LOCK = 14

TIMER_SLACK_NS = 1
SWITCH_INTERVAL_S = 0.5e-3

Undo = Callable[[], object]


class RealTimeError(Exception):
    """Mode `enforce` asked for what this machine refuses."""


@dataclass(frozen=True, slots=True)
class RealTimeSettings:
    """How a daemon asks for punctuality; CPUs are numbers of this machine, None is any."""

    mode: Literal["enforce", "try", "off"] = "try"
    priority: Annotated[int, Field(ge=1, le=99)] = 80
    local_cpu: Annotated[int, Field(ge=0)] | None = None
    remote_cpu: Annotated[int, Field(ge=0)] | None = None


@dataclass(frozen=True, slots=True)
class Refusal:
    """What was asked, why the system said no, and how to grant it."""

    asked: str
    reason: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.asked} refused ({self.reason}); {self.remedy}"


class RealTimeReport:
    """What was granted and refused; `release`, or leaving `with`, restores all that was changed."""

    def __init__(
        self, granted: tuple[str, ...], refused: tuple[Refusal, ...], undo: tuple[Undo, ...]
    ) -> None:
        self.granted = granted
        self.refused = refused
        self._undo = list(undo)

    def release(self) -> None:
        """Restore scheduler, affinity, memory, timer slack and garbage collector; idempotent.

        Call it in the thread that called `apply_real_time`.
        """
        while self._undo:
            self._undo.pop()()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()


@dataclass(frozen=True, slots=True)
class _Step:
    asked: str
    apply: Callable[[], Undo]
    remedy: str


def apply_real_time(settings: RealTimeSettings, cpu: int | None = None) -> RealTimeReport:
    """Apply the settings to this process and, where Linux counts by thread, to this thread.

    Call it in the loop's thread after helper threads have started, so that they stay ordinary.
    Raises RealTimeError in mode `enforce` if anything is refused; then nothing stays changed.
    """
    granted: list[str] = []
    refused: list[Refusal] = []
    undo: list[Undo] = []
    for step in _steps(settings, cpu):
        try:
            undo.append(step.apply())
        except OSError as error:
            refused.append(Refusal(step.asked, error.strerror or str(error), step.remedy))
        else:
            granted.append(step.asked)
    report = RealTimeReport(tuple(granted), tuple(refused), tuple(undo))
    if refused and settings.mode == "enforce":
        report.release()
        listed = "\n".join(f"  {refusal}" for refusal in refused)
        raise RealTimeError(
            f'real_time.mode = "enforce", but this machine refuses:\n{listed}\n'
            'or run with real_time.mode = "try"'
        )
    return report


def _steps(settings: RealTimeSettings, cpu: int | None) -> Iterator[_Step]:
    if settings.mode == "off":
        return
    yield _Step("quick hand-over between threads", _shorten_switch_interval, "")
    yield _Step("garbage collector off", _freeze_collector, "")
    yield _Step(f"timer slack {TIMER_SLACK_NS} ns", _cut_timer_slack, "allow prctl")
    if cpu is not None:
        allowed = sorted(os.sched_getaffinity(0))
        yield _Step(f"CPU {cpu}", lambda: _pin_to(cpu), f"choose one of the CPUs {allowed}")
    yield _Step(
        "memory locked",
        _lock_memory,
        "grant `memlock unlimited` in /etc/security/limits.conf and log in again",
    )
    yield _Step(
        f"SCHED_FIFO priority {settings.priority}",
        lambda: _schedule(settings.priority),
        f"grant `rtprio {settings.priority}` in /etc/security/limits.conf and log in again",
    )


def _shorten_switch_interval() -> Undo:
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    return lambda: sys.setswitchinterval(before_s)


def _freeze_collector() -> Undo:
    # The loop makes no cycles; a collection would walk every object of every library, for ms.
    was_enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()

    def undo() -> None:
        gc.unfreeze()
        if was_enabled:
            gc.enable()

    return undo


def _cut_timer_slack() -> Undo:
    before_ns = _libc_call("prctl", _PR_GET_TIMERSLACK, 0, 0, 0, 0)
    _libc_call("prctl", _PR_SET_TIMERSLACK, TIMER_SLACK_NS, 0, 0, 0)
    return lambda: _libc_call("prctl", _PR_SET_TIMERSLACK, before_ns, 0, 0, 0)


def _pin_to(cpu: int) -> Undo:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {cpu})
    return lambda: os.sched_setaffinity(0, before)


def _lock_memory() -> Undo:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and not _may_lock_without_limit():
        # It might succeed now, and make a later allocation of the running loop fail.
        raise PermissionError(1, f"the limit on locked memory is {limit} bytes")
    _libc_call("mlockall", _MCL_CURRENT | _MCL_FUTURE)
    return lambda: _libc_call("munlockall")


def _schedule(priority: int) -> Undo:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    # Threads and processes started from here are ordinary again.
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    return lambda: os.sched_setscheduler(0, policy, parameters)


def _may_lock_without_limit() -> bool:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> _CAP_IPC_LOCK & 1)
    return False


def _libc_call(name: str, *arguments: int) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    result: int = getattr(libc, name)(*(ctypes.c_ulong(value) for value in arguments))
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return result
