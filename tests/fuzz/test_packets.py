"""The fuzzer's own test: a short run finds nothing, and reaches every reason."""

import subprocess
import sys
from pathlib import Path

import pytest

from channel.packet import Reject
from tests.fuzz.packets import run

ROOT = Path(__file__).parents[2]


def test_a_short_run_reaches_every_reason_and_finds_nothing() -> None:
    tally = run(20_000, seed=20)
    assert tally.hostile == 20_000
    assert set(tally.rejected) == set(Reject)
    assert min(tally.rejected.values()) > 50
    assert tally.forged > 50


def test_one_seed_is_one_run() -> None:
    assert run(2_000, seed=3) == run(2_000, seed=3)
    assert run(2_000, seed=3) != run(2_000, seed=4)


@pytest.mark.parametrize("module", ["packets", "atheris_packet"])
def test_the_programs_end_well(module: str) -> None:
    arguments = {"packets": ["--count", "1000"], "atheris_packet": ["--", "-runs=300"]}[module]
    done = subprocess.run(
        [sys.executable, "-m", f"tests.fuzz.{module}", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
