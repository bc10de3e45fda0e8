"""The top level is the architecture: nothing foreign shadows it, and imports point down."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from farhand.__main__ import COMMANDS, app

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PYPROJECT["tool"]["importlinter"]["root_packages"]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_foreign_package_of_the_same_name_is_imported(package: str) -> None:
    imported = importlib.import_module(package)
    assert imported.__file__ is not None
    assert Path(imported.__file__).parent == ROOT / package


def test_every_package_is_checked_shipped_and_typed() -> None:
    on_disk = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert on_disk == set(PACKAGES)
    assert on_disk == set(PYPROJECT["tool"]["mypy"]["packages"])
    shipped = PYPROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    assert on_disk == {pattern.removesuffix("*") for pattern in shipped}
    assert all((ROOT / package / "py.typed").is_file() for package in on_disk)


def test_imports_point_down() -> None:
    check = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports())"
    done = subprocess.run(
        [sys.executable, "-c", check], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_command_is_there_for_everything_people_do() -> None:
    assert {"local", "remote", "dashboard", "demo", "simulate", "certify"} <= set(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"])
    assert result.exit_code == 0, result.output
    assert "Usage" in result.output


def test_a_site_has_neither_viewer_nor_benchmarks_in_its_memory() -> None:
    look = (
        "import sys; from farhand.__main__ import app; "
        "app(['remote', '--help'], standalone_mode=False); "
        "print(*sorted({'rerun', 'experiments', 'telemetry.dashboard'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", look], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1].strip() == ""


@pytest.mark.parametrize("module", ["farhand", "local_site", "remote_site"])
def test_every_module_that_runs_explains_itself(module: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", module, "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout
