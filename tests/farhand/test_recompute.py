"""`farhand recompute` on recordings of the demo's sites, run on a manual clock."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from site_runtime.keys import SiteId
from site_runtime.session import load_session
from telemetry.recording import read_recording
from tests.fakes.recordings import record
from tests.loopback.conftest import EXPERIMENTS, Pair

DEMO = EXPERIMENTS / "demo.toml"


@pytest.fixture(scope="module")
def pair() -> Pair:
    pair = Pair(load_session(DEMO))
    pair.run(1.5)
    return pair


def recorded(pair: Pair, folder: Path, site: SiteId, *, skip: int = 0, bend: int = -1) -> Path:
    """A recording of a site; from row `skip` on, one torque of row `bend` by one bit another."""
    stream = pair.sites[site].telemetry
    rows = stream.last(10_000)
    rows["torque_nm"].view(np.uint64)[bend, 0] ^= bend >= 0
    path = folder / f"rows-20251124T160000.000Z-{site.label}.mcap"
    arrivals = stream.ring.arrivals_from(0)
    return record(
        path,
        site.label,
        rows[skip:],
        pair.session,
        epoch=stream.ring.layout.epoch,
        arrivals=arrivals if skip == 0 else arrivals[:0],
    )


def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "farhand", "recompute", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | {"COLUMNS": "200"},
    )


def test_what_both_sites_commanded_is_verified(pair: Pair, tmp_path: Path) -> None:
    for site in SiteId:
        recorded(pair, tmp_path, site)
    done = run(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    for site in SiteId:
        assert f"{site.label} site  1500 rows" in done.stdout
    assert done.stdout.count("bit by bit as recorded") == 2


def test_a_bit_that_differs_is_located_and_the_exit_code_tells(pair: Pair, tmp_path: Path) -> None:
    done = run(recorded(pair, tmp_path, SiteId.LOCAL, bend=1234))
    assert done.returncode == 1
    [line] = [line for line in done.stdout.splitlines() if "torque_nm" in line]
    assert "1 of 1500" in line
    assert "row 1234, 1.235 s" in line


def test_a_part_of_a_run_is_verified_by_its_commands(pair: Pair, tmp_path: Path) -> None:
    done = run(recorded(pair, tmp_path, SiteId.REMOTE, skip=800))
    assert done.returncode == 0
    assert "it begins with row 800: not computed from the packets on" in done.stdout
    assert "699 rows, 6 columns" in done.stdout


def test_other_gains_are_compared_and_written_as_a_recording(pair: Pair, tmp_path: Path) -> None:
    text = DEMO.read_text()
    softer = text.replace("stiffness_n_per_m = [", "stiffness_n_per_m = [7", 1)
    assert softer != text
    other = tmp_path / "other.toml"
    other.write_text(softer)
    done = run(
        recorded(pair, tmp_path / "in", SiteId.LOCAL),
        "--session", other, "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "joint 2" in done.stdout
    assert "coupling [N]" in done.stdout
    assert "bit by bit" not in done.stdout
    [path] = (tmp_path / "out").iterdir()
    computed = read_recording(path)["local"]
    assert computed.metadata["source"] == "recomputed"
    assert computed.session_text == softer
    mine = pair.sites[SiteId.LOCAL].telemetry.last(1500)
    assert np.array_equal(computed.rows["q"], mine["q"])
    assert not np.array_equal(computed.rows["torque_nm"], mine["torque_nm"])


def test_a_recording_holds_the_robot_that_its_session_names(tmp_path: Path) -> None:
    pair = Pair(load_session(EXPERIMENTS / "seven_dof.toml"))
    pair.run(0.3)
    done = run(recorded(pair, tmp_path, SiteId.REMOTE))
    assert done.returncode == 0, done.stderr
    assert "bit by bit as recorded" in done.stdout
    assert done.stderr == ""


def test_other_robots_are_refused(pair: Pair, tmp_path: Path) -> None:
    path = recorded(pair, tmp_path, SiteId.LOCAL)
    done = run(path, "--session", EXPERIMENTS / "seven_dof.toml")
    assert done.returncode == 2
    assert "is not the recorded one" in done.stderr
