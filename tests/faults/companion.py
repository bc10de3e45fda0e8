"""A process that serves a test: it says "ready", answers lines with lines, ends with its stdin."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
_END_S = 10.0


class Companion:
    """Started and ready, or OSError. When its owner dies in any way, its stdin ends, and it too."""

    def __init__(self, command: Sequence[str]) -> None:
        self._process = subprocess.Popen(
            list(command),
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a Ctrl-C ends it through its owner, so that it can tidy up
        )
        if self._read() != "ready\n":
            self.close()
            raise OSError(f"did not start: {' '.join(command)}; its error stands above")

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def ask(self, line: str) -> str:
        """Send one line; return the line that answers it."""
        assert self._process.stdin is not None
        self._process.stdin.write(line)
        self._process.stdin.flush()
        return self._read()

    def kill(self) -> None:
        """Kill it at once, as the kernel would."""
        self._process.kill()
        self.close()

    def close(self) -> None:
        """Let it end, or make it. Idempotent."""
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        if not process.stdin.closed:
            process.stdin.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()
