"""Commands of the project as processes beside a test."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
DEADLINE_S = 60.0


@contextmanager
def running(*arguments: str, log: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Run `python -m ...` until the end of a `with` statement, which interrupts it."""
    with (log or Path(os.devnull)).open("ab") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
        )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=DEADLINE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise


def farhand(*words: object, width: int = 80) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, its tables so many columns wide."""
    return subprocess.run(
        [sys.executable, "-m", "farhand", *map(str, words)],
        cwd=ROOT,
        env=os.environ | {"COLUMNS": str(width)},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
