"""docs/hardware.md: its worked example is installed and used as it stands there."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from hardware.registry import drivers, force_sensors

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "hardware.md").read_text(encoding="utf-8")

# What the vendor would ship: an arm of two joints, each with an inertia.
SDK = """
import math, time
class Arm:
    def __init__(self, address):
        assert address == "10.0.0.7"
        self.angle, self.speed, self.torque, self.on = [0.3, 1.2], [0.0, 0.0], [0.0, 0.0], False
        self.then = time.monotonic()
    def sample(self):
        now = time.monotonic()
        for i in range(2):
            self.speed[i] += (now - self.then) * self.torque[i] * self.on / 0.002
            self.angle[i] += (now - self.then) * self.speed[i]
        self.then = now
        return [math.degrees(a) for a in self.angle], [math.degrees(s) for s in self.speed], \\
            time.monotonic_ns()
    def command(self, torque):
        self.torque = torque
    def power(self, on):
        self.on = on
    def disconnect(self):
        assert not self.on
"""


def block(name: str) -> str:
    """The code on the page that begins with a comment of this name."""
    found = re.search(rf"```\w+\n(# {re.escape(name)}\n.*?)```", PAGE, re.DOTALL)
    assert found is not None, f"the page has no {name}"
    return found[1]


def farhand(site_packages: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "farhand", *map(str, arguments)],
        cwd=ROOT,
        env={"PYTHONPATH": str(site_packages), "COLUMNS": "200", "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The example as an installer leaves it: its module, and metadata with its entry points."""
    project = tomllib.loads(block("pyproject.toml"))["project"]
    folder = tmp_path / "site-packages"
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {target}" for name, target in points.items()))
    ]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (folder / "acme_arm.py").write_text(block("acme_arm.py"))
    return folder


def test_the_example_is_listed_with_what_it_lacks_and_then_without(installed: Path) -> None:
    listed = farhand(installed, "devices")
    assert listed.returncode == 0, listed.stderr
    row = next(line for line in listed.stdout.splitlines() if "acme_arm" in line)
    assert "acme_sdk is not installed; it is on the arm's USB stick" in row
    (installed / "acme_sdk.py").write_text(SDK)
    listed = farhand(installed, "devices")
    row = next(line for line in listed.stdout.splitlines() if "acme_arm" in line)
    assert "nothing missing" in row


def test_the_example_drives_a_session_s_robot(installed: Path, tmp_path: Path) -> None:
    (installed / "acme_sdk.py").write_text(SDK)
    text = (ROOT / "experiments" / "figure_5.toml").read_text(encoding="utf-8")
    begin, end = text.index("[local.device]"), text.index("[local.operator]")
    own = """[local.device]
driver = "acme_arm"
address = "10.0.0.7"
stale_after_s = 0.5

[local.limits]
torque_nm = [0.2, 0.2]
velocity_rad_s = [5.0, 5.0]

"""
    session = tmp_path / "acme.toml"
    session.write_text(text[:begin] + own + text[end:], encoding="utf-8")
    checked = farhand(
        installed,
        "device-check",
        session,
        "--site",
        "local",
        "--seconds",
        "0.3",
        "--torque",
        "--yes",
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert checked.stdout.count("moves with the torque") == 4
    session.write_text(session.read_text().replace("stale_after_s = 0.5", "stale_after_s = 2.0"))
    refused = farhand(installed, "device-check", session, "--site", "local")
    assert refused.returncode == 2
    assert "stale_after_s is 2.0; choose above 0 and at most 1 s" in refused.stderr


def test_the_page_names_every_driver() -> None:
    for name in (*drivers(), *force_sensors()):
        assert f"`{name}`" in PAGE
