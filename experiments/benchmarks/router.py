"""`farhand router` as a process, for sites that meet through it."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from experiments.benchmarks.figures import BenchmarkError
from experiments.benchmarks.sites import DEMO, LONGEST_S, free_endpoint
from site_runtime.session_edit import edited


@dataclass(frozen=True, slots=True)
class Router:
    """Where it listens, and its process."""

    endpoint: str
    pid: int


@contextmanager
def routing() -> Iterator[Router]:
    """Run a router; without certificates, it relays sessions of any name."""
    endpoint = free_endpoint()
    with TemporaryDirectory(prefix="farhand-bench-") as folder:
        session = Path(folder) / "router.toml"
        changes = {"name": "bench-router", "network.router": endpoint}
        session.write_text(edited(DEMO.read_text(encoding="utf-8"), changes), encoding="utf-8")
        command = ("farhand", "router", str(session), "--duration", str(LONGEST_S))
        with subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-m", *command],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        ) as process:
            try:
                assert process.stderr is not None  # noqa: S101 - a pipe was asked for
                if not (line := process.stderr.readline()).startswith(b"farhand router"):
                    raise BenchmarkError(f"the router did not start: {line.decode().strip()}")
                yield Router(endpoint, process.pid)
            finally:
                process.kill()
