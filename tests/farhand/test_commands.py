"""The command line, as a person meets it."""

import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from farhand.__main__ import app
from hardware.registry import driver
from site_runtime.certification import certify as certify_session
from site_runtime.session import load_session
from site_runtime.session_edit import edited
from telemetry.result_file import read_result
from tests.fakes.hd import fake_hd

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
DEMO = EXPERIMENTS / "demo.toml"


def farhand(*arguments: str | float | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    "command",
    [
        "local",
        "remote",
        "dashboard",
        "demo",
        "simulate",
        "info",
        "certify",
        "design",
        "reproduce",
        "commission-quanser",
        None,
    ],
)
def test_every_command_offers_help(command: str | None) -> None:
    result = farhand(*([command] if command else []), "--help")
    assert result.exit_code == 0
    assert "Usage:" in result.output


def test_simulate_writes_the_same_bytes_each_time(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("first.parquet", "second.parquet")]
    for file in files:
        assert farhand("simulate", DEMO, "--duration", "1.5", "--out", file).exit_code == 0
    first, second = (file.read_bytes() for file in files)
    assert first == second


def test_simulate_tells_and_keeps_what_happened(tmp_path: Path) -> None:
    out = tmp_path / "run.parquet"
    result = farhand("simulate", DEMO, "--duration", "1.5", "--out", out)
    assert "position error" in result.output
    assert "det(JJᵀ)" in result.output
    assert "nearest to an obstacle" in result.output
    run = read_result(out)
    assert run.time_s[0] == 0.0
    assert run.time_s[-1] == pytest.approx(1.5)
    assert np.isfinite(run.columns["remote_link_distance_m"]).all()
    assert run.metadata["session"] == DEMO.read_text(encoding="utf-8")
    assert {"farhand", "numpy", "pin", "python", "session_digest"} <= run.metadata.keys()


def test_simulate_refuses_a_folder_that_is_not_there_before_it_works(tmp_path: Path) -> None:
    result = farhand("simulate", DEMO, "--out", tmp_path / "nowhere" / "run.parquet")
    assert result.exit_code == 2


def test_simulate_ends_with_one_when_a_site_fails(tmp_path: Path) -> None:
    session = tmp_path / "session.toml"
    text = DEMO.read_text(encoding="utf-8")
    # Damping far beyond what the rate can carry, and nothing that limits it: the loop is unstable.
    text = text.replace("task_n_s_per_m = [30.0, 30.0]", "task_n_s_per_m = [2e4, 2e4]")
    session.write_text(re.sub(r"^limits = .*$", "", text, flags=re.MULTILINE))
    result = farhand("simulate", session, "--duration", "5")
    assert result.exit_code == 1
    assert "diverged" in result.output


def test_simulate_tells_of_a_failure_at_time_zero(tmp_path: Path) -> None:
    session = tmp_path / "session.toml"
    text = (EXPERIMENTS / "figure_2.toml").read_text(encoding="utf-8")
    # A singular pose, where the paper's own projector has no value.
    text, count = re.subn(
        r"initial_position_rad = \[[^\]]*,[^\]]*,[^\]]*\]",
        "initial_position_rad = [0.0, 0.0, 0.0]",
        text,
    )
    assert count == 1
    session.write_text(text)
    out = tmp_path / "run.parquet"
    result = farhand("simulate", session, "--duration", "1", "--out", out)
    assert result.exit_code == 1
    assert "FAULT remote: ZeroDivisionError" in result.output
    assert read_result(out).time_s.shape == (0,)


@pytest.mark.parametrize(
    ("session", "theorem"),
    [("paper_free", "Theorem A"), ("theorem_b", "Theorem B"), ("demo", "Theorem B")],
)
def test_certify_names_the_theorem(session: str, theorem: str) -> None:
    result = farhand("certify", EXPERIMENTS / f"{session}.toml")
    assert result.exit_code == 0
    assert f"certified by {theorem}" in result.output


def test_simulate_opens_no_real_device() -> None:
    result = farhand("simulate", EXPERIMENTS / "bench_fake.toml", "--duration", "1")
    assert result.exit_code == 2
    assert 'local.device.driver = "phantom"' in result.output


def test_simulate_opens_no_force_sensor(tmp_path: Path) -> None:
    text = (EXPERIMENTS / "bench_fake.toml").read_text(encoding="utf-8")
    simulated = {"driver": "simulated", "initial_position_rad": [0.8, 1.6]}
    session = tmp_path / "session.toml"
    session.write_text(edited(text, {"local.device": simulated}), encoding="utf-8")
    result = farhand("simulate", session, "--duration", "1")
    assert result.exit_code == 2
    assert "local.force_sensor" in result.output


@pytest.mark.parametrize(("session", "told"), [("seven_dof", True), ("demo", False)])
def test_certify_tells_that_losses_are_not_in_the_round_trip(session: str, told: bool) -> None:
    result = farhand("certify", EXPERIMENTS / f"{session}.toml")
    assert ("losses are not in it" in result.output) is told


def test_certify_refuses_a_session_whose_delay_is_too_long(tmp_path: Path) -> None:
    session = tmp_path / "session.toml"
    text = DEMO.read_text(encoding="utf-8")
    session.write_text(text.replace("mean_s = 0.05", "mean_s = 0.15"))
    result = farhand("certify", session)
    assert result.exit_code == 1
    assert "not certified" in result.output


LATE = {f"channel.{way}.delay.mean_s": 0.15 for way in ("local_to_remote", "remote_to_local")}
CHANGE = re.compile(r"([a-z_]+(?:\.[a-z_]+)+) from (?:\[.*?\]|\S+) to (\[.*?\]|\S+)")


def changed_demo(tmp_path: Path, changes: dict[str, Any]) -> Path:
    session = tmp_path / "session.toml"
    session.write_text(edited(DEMO.read_text(encoding="utf-8"), changes))
    return session


def test_each_change_that_certify_prints_certifies_when_it_is_made(tmp_path: Path) -> None:
    session = changed_demo(tmp_path, LATE)
    result = farhand("certify", session)
    lines = [line for line in result.output.splitlines() if CHANGE.search(line)]
    assert len(lines) == 4  # task damping, joint damping, stiffness, round trip
    for line in lines:
        changes = {key: tomllib.loads(f"x = {value}")["x"] for key, value in CHANGE.findall(line)}
        mended = tmp_path / "mended.toml"
        mended.write_text(edited(session.read_text(), changes))
        assert farhand("certify", mended).exit_code == 0, line
        session_text = session.read_text()
        assert edited(session_text, changes) != session_text


def test_certify_numbers_the_cheapest_first_and_says_what_the_rate_does_not_carry(
    tmp_path: Path,
) -> None:
    result = farhand("certify", changed_demo(tmp_path, LATE))
    assert "1. raise local.damping.task_n_s_per_m from [30, 30] to [36.7, 36.7]" in result.output
    assert "2. lower coupling.stiffness_n_per_m from [200, 200] to [163, 163]" in result.output
    assert "not advised: raise local.damping.joint_nm_s" in result.output
    assert "1000 Hz carries only local.damping.joint_nm_s ≤" in result.output


def test_certify_tells_of_the_velocity_filter_where_there_is_one(tmp_path: Path) -> None:
    encoder = {"remote.device.encoder_resolution_rad": 1e-4}
    stiff = {"coupling.stiffness_n_per_m": [1000.0, 1000.0]}
    output = farhand("certify", changed_demo(tmp_path, encoder | stiff)).output
    assert "remote: velocity filter, τ_f·λ_max(M⁻¹Λ) =" in output
    assert "local: velocity filter" not in output
    assert "the velocity filter of 0.0038 s carries only remote.damping" in output
    assert "velocity filter" not in farhand("certify", DEMO).output


def test_certify_tells_where_damping_exceeds_what_the_rate_carries(tmp_path: Path) -> None:
    paper = farhand("certify", EXPERIMENTS / "paper_free.toml").output
    assert "a search of 2000" in paper
    assert re.search(r"remote: a = 0\.74\d, above the advised 0\.4, at \[.*\] rad", paper)
    heavy = changed_demo(tmp_path, {"local.damping.task_n_s_per_m": [400.0, 400.0]})
    assert "UNSTABLE with one tick of latency" in farhand("certify", heavy).output


@pytest.mark.parametrize("base", ["demo", "seven_dof", "paper_free"])
def test_design_writes_a_session_that_certify_accepts(base: str, tmp_path: Path) -> None:
    out = tmp_path / "stiffer.toml"
    wish = ("--round-trip", 0.45, "--stiffness", 120, "--margin", 1.1, "--out", out)
    result = farhand("design", EXPERIMENTS / f"{base}.toml", *wish)
    assert result.exit_code == 0, result.output
    assert "is certified" in result.output
    assert "injects" not in result.output
    session = load_session(out)
    assert session.name == "stiffer"
    assert certify_session(session).best.round_trip_s > 1.1 * 0.45
    assert farhand("certify", out).exit_code == 0
    text = (EXPERIMENTS / f"{base}.toml").read_text(encoding="utf-8")
    assert re.findall("#.*", out.read_text()) == re.findall("#.*", text)


def test_design_says_when_the_session_injects_more_than_was_wanted(tmp_path: Path) -> None:
    def output(round_trip: float) -> str:
        out = tmp_path / "new.toml"
        wish = ("--round-trip", round_trip, "--stiffness", 100, "--out", out, "--force")
        result = farhand("design", DEMO, *wish)
        assert result.exit_code == 0
        return result.output

    assert "injects up to 164.0 ms, more than wanted: with that it is not certified" in output(0.1)
    assert "injects up to 164.0 ms, more than wanted: with that it is still cert" in output(0.15)
    assert "more than wanted" not in output(0.165)


def test_design_says_why_there_is_none_and_what_there_would_be(tmp_path: Path) -> None:
    out = tmp_path / "new.toml"

    def result(stiffness: str) -> Result:
        return farhand("design", DEMO, "--round-trip", 0.4, "--stiffness", stiffness, "--out", out)

    refused = result("800")
    assert refused.exit_code == 1
    assert not out.exists()
    assert "asks for a task damping of 193 N·s/m" in refused.output
    for site in ("local", "remote"):
        assert re.search(rf"{site} carries \S+ N·s/m at 1000 Hz .*worst pose is \[", refused.output)
    stated = re.search(r"--stiffness (\S+)", refused.output)
    assert stated is not None
    assert re.search(r"--round-trip 0\.\d+", refused.output)
    assert re.search(r"loop\.rate_hz = \d+", refused.output)
    assert result(stated[1]).exit_code == 0
    assert out.exists()


def test_design_refuses_to_overwrite_unless_told_to(tmp_path: Path) -> None:
    out = tmp_path / "new.toml"
    out.write_text("mine")
    wish = ("design", DEMO, "--round-trip", 0.2, "--stiffness", 100, "--out", out)
    assert farhand(*wish).exit_code == 2
    assert out.read_text() == "mine"
    assert farhand(*wish, "--force").exit_code == 0
    assert load_session(out).coupling.stiffness_n_per_m == (100.0, 100.0)


@pytest.mark.parametrize(
    ("out", "stiffness"),
    [("no good name.toml", 100), ("nowhere/new.toml", 100), ("new.toml", 0), ("new.toml", "nan")],
)
def test_design_refuses_what_cannot_be_before_it_writes(
    out: str, stiffness: object, tmp_path: Path
) -> None:
    path = tmp_path / out
    wish = ("design", DEMO, "--round-trip", "0.2", "--stiffness", str(stiffness), "--out", path)
    result = farhand(*wish)
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)
    assert not path.exists()


@pytest.mark.parametrize("command", ["local", "remote", "dashboard", "simulate", "certify"])
def test_a_session_that_is_not_there_is_a_message_not_a_traceback(command: str) -> None:
    result = farhand(command, "nowhere.toml")
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)


def test_devices_lists_drivers_and_what_a_session_uses() -> None:
    result = farhand("devices")
    assert result.exit_code == 0
    for name in ("serial_pair", "simulated"):
        assert name in result.output
    result = farhand("devices", DEMO)
    assert result.exit_code == 0
    assert "local device" in result.output
    assert "nothing missing" in result.output


def test_devices_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = driver("simulated")
    asked = []

    def lack(settings: object) -> str:
        asked.append(settings)
        return "its library [of the vendor]"

    monkeypatch.setattr("farhand.devices.driver", lambda _: replace(entry, missing=lack))
    for arguments, code in (((), 0), ((DEMO,), 1)):
        result = farhand("devices", *arguments)
        assert result.exit_code == code
        assert "its library [of the vendor]" in result.output
    session = load_session(DEMO)
    assert asked[-2:] == [session.local.device, session.remote.device]


def test_device_check_reads_and_pushes_only_when_told_to() -> None:
    command = ["device-check", DEMO, "--site", "local", "--seconds", "0.2"]
    result = farhand(*command)
    assert result.exit_code == 0
    assert "readings/s of 1000 asked" in result.output
    assert "q2 [rad]" in result.output
    assert "Fz [N]" in result.output
    assert "answer" not in result.output
    refused = CliRunner().invoke(app, [*map(str, command), "--torque"], input="n\n")
    assert "Push? [y/N]" in refused.output
    assert "answer" not in refused.output
    pushed = farhand(*command, "--torque", "--yes")
    assert pushed.exit_code == 0, pushed.output
    assert pushed.output.count("moves with") == 4


def test_device_check_needs_limits_before_it_pushes(tmp_path: Path) -> None:
    result = farhand("device-check", EXPERIMENTS / "figure_5.toml", "--site", "remote", "--torque")
    assert result.exit_code == 2
    assert "remote.limits.torque_nm is missing" in result.output
    assert farhand("device-check", DEMO, "--site", "left").exit_code == 2


@pytest.mark.processes
def test_device_check_finds_fakes_where_there_is_no_hardware() -> None:
    if reason := fake_hd.missing():
        pytest.skip(reason)
    root = EXPERIMENTS.parent
    command = ["device-check", EXPERIMENTS / "bench_fake.toml", "--site", "local"]
    done = subprocess.run(
        [sys.executable, "-m", "farhand", *map(str, command), "--seconds", "0.5", "--fake"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "local device (phantom)" in done.stdout
    assert "q2 [rad]" in done.stdout
