"""The preloaded wall clock jumps in the process that has it, and the monotonic one does not."""

import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.faults import wall_clock
from tests.faults.wall_clock import WallClock

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(wall_clock.COMPILER is None, reason="no C compiler `cc`"),
]

ASK = """
import datetime, sys, time
for _ in sys.stdin:
    print(time.time(), datetime.datetime.now().timestamp(), time.monotonic(), flush=True)
"""


def test_it_steps_while_the_process_runs(tmp_path: Path) -> None:
    with closing(WallClock(tmp_path, "clock")) as clock:
        process = subprocess.Popen(
            [sys.executable, "-c", ASK],
            env=os.environ | clock.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        with process:
            assert process.stdin is not None
            assert process.stdout is not None
            for offset_s in (0.0, 3600.0, -3600.0):
                clock.set(offset_s)
                asked = clock.asked
                process.stdin.write("now\n")
                process.stdin.flush()
                wall_s, date_s, monotonic_s = map(float, process.stdout.readline().split())
                assert abs(wall_s - time.time() - offset_s) < 20.0
                assert abs(date_s - time.time() - offset_s) < 20.0
                assert abs(monotonic_s - time.monotonic()) < 20.0
                assert clock.asked >= asked + 2
            process.stdin.close()
