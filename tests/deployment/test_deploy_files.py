"""What deploy/ has: units that systemd takes, of commands that there are; a container's files."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from farhand.__main__ import app
from tests.deployment.page import ROOT

DEPLOY = ROOT / "deploy"
UNITS = sorted(path.name for path in DEPLOY.glob("*.service"))
VERIFY = shutil.which("systemd-analyze")


def unit(name: str) -> str:
    return (DEPLOY / name).read_text(encoding="utf-8")


def value(name: str, key: str) -> str:
    (found,) = re.findall(rf"^{key}=(.*)$", unit(name), re.MULTILINE)
    return found


@pytest.mark.skipif(VERIFY is None, reason="no systemd-analyze")
@pytest.mark.parametrize("name", UNITS)
def test_systemd_takes_the_unit_without_a_word(name: str, tmp_path: Path) -> None:
    file = tmp_path / name
    # the program is not installed there on every machine
    program = value(name, "ExecStart").split()[0]
    file.write_text(unit(name).replace(program, str(shutil.which("true"))), encoding="utf-8")
    done = subprocess.run(
        [str(VERIFY), "verify", "--man=no", file], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("name", UNITS)
def test_a_unit_starts_a_command_that_there_is_and_watches_it(name: str) -> None:
    program, command, session, *options = value(name, "ExecStart").split()
    assert program == "/opt/farhand/bin/farhand"
    told = CliRunner().invoke(app, [command, session, *options])
    assert told.exit_code == 2
    assert session in told.output  # it went as far as reading the file, which is not there
    assert value(name, "Type") == "notify"
    assert 0 < int(value(name, "WatchdogSec")) < 60
    assert value(name, "User") != "root"


def test_the_container_s_file_copies_what_is_there_and_every_package() -> None:
    lines = re.findall(
        r"^COPY (.*) \S+$", (DEPLOY / "Containerfile").read_text("utf-8"), re.MULTILINE
    )
    copied = {name for line in lines for name in line.split()}
    assert all((ROOT / name).exists() for name in copied)
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(pyproject["tool"]["importlinter"]["root_packages"]) <= copied
