"""A process beside a site's own that reads its rows, from memory that both share."""

import mmap
import os
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


class SharedMemory:
    """Memory that a process started later may use too; it lasts as long as one of them does."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("farhand-rows")

    def allocate(self, size: int) -> mmap.mmap:
        """Return zeroed memory of so many bytes, all of it present. Once."""
        os.ftruncate(self.descriptor, size)
        return mmap.mmap(self.descriptor, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)

    def close(self) -> None:
        """Give up the descriptor; what is mapped stays."""
        os.close(self.descriptor)


class Companion:
    """A running `python -m module`: its argument is the memory's descriptor, its input one line.

    The input ends when the site closes it, or dies in whatever way.
    """

    def __init__(
        self, module: str, memory: SharedMemory, line: str, *, answers: bool = False
    ) -> None:
        root = str(Path(__file__).parents[1])
        paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            [
                sys.executable,
                "-P",  # no other `telemetry` that lies in the working directory
                "-m",
                module,
                str(memory.descriptor),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if answers else subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,  # it may outlive the site
            cwd="/",
            pass_fds=(memory.descriptor,),
            env=os.environ | {"PYTHONPATH": paths},
            start_new_session=True,
        )
        assert self._process.stdin is not None  # noqa: S101 - a pipe was asked for
        with suppress(BrokenPipeError):  # it has ended, which its exit code tells
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """How it ended, None while it runs. From any thread."""
        return self._process.poll()

    def answer(self, patience_s: float) -> str | None:
        """Return the one line of one that `answers`: "" if it ends, None if it takes longer."""
        output = self._process.stdout
        assert output is not None  # noqa: S101
        with output:
            readable, _, _ = select.select([output], [], [], patience_s)
            return output.readline().decode() if readable else None

    def close(self, patience_s: float) -> None:
        """Tell it that the site has ended; wait for its end, but not for ever."""
        assert self._process.stdin is not None  # noqa: S101
        with suppress(OSError):
            self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)

    def kill(self) -> None:
        """End it at once, and wait for its end."""
        self._process.kill()
        self.close(patience_s=1.0)


def stand_back() -> None:
    """For the companion: take nothing from the loop, neither its priority nor its CPU."""
    # The site ends this process in its own time, and a service manager tells every process of it.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(OSError):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def input_ended(descriptor: int, patience_s: float) -> bool:
    """For the companion: wait so long for the end of its input, which is that of the site."""
    readable, _, _ = select.select([descriptor], [], [], patience_s)
    return bool(readable) and not os.read(descriptor, 1)
