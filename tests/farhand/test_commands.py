"""The command line, as a person meets it."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from farhand.__main__ import app
from telemetry.result_file import read_result

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
DEMO = EXPERIMENTS / "demo.toml"


def farhand(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    "command", ["local", "remote", "dashboard", "demo", "simulate", "certify", "reproduce", None]
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
    result = farhand("simulate", session, "--duration", "1")
    assert result.exit_code == 1
    assert "FAULT remote: ZeroDivisionError" in result.output


@pytest.mark.parametrize(
    ("session", "theorem"),
    [("paper_free", "Theorem A"), ("theorem_b", "Theorem B"), ("demo", "Theorem B")],
)
def test_certify_names_the_theorem(session: str, theorem: str) -> None:
    result = farhand("certify", EXPERIMENTS / f"{session}.toml")
    assert result.exit_code == 0
    assert f"certified by {theorem}" in result.output


def test_certify_refuses_a_session_whose_delay_is_too_long(tmp_path: Path) -> None:
    session = tmp_path / "session.toml"
    text = DEMO.read_text(encoding="utf-8")
    session.write_text(text.replace("mean_s = 0.05", "mean_s = 0.15"))
    result = farhand("certify", session)
    assert result.exit_code == 1
    assert "not certified" in result.output


@pytest.mark.parametrize("command", ["local", "remote", "dashboard", "simulate", "certify"])
def test_a_session_that_is_not_there_is_a_message_not_a_traceback(command: str) -> None:
    result = farhand(command, "nowhere.toml")
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)
