from dataclasses import replace
from pathlib import Path

import pytest

from site_runtime.flight_recorder import INCIDENT_STATES, recorder_folder
from site_runtime.session import RecorderSettings, load_session, parse_session
from site_runtime.supervisor import State

DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"


@pytest.mark.parametrize(
    ("state_home", "expected"),
    [("/var/state", "/var/state"), ("relative", "/home/me/.local/state"), ("", None)],
)
def test_recordings_go_to_the_user_s_state(
    monkeypatch: pytest.MonkeyPatch, state_home: str, expected: str | None
) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setenv("XDG_STATE_HOME", state_home)
    folder = recorder_folder(load_session(DEMO), "local")
    assert folder == Path(expected or "/home/me/.local/state") / "farhand" / "demo" / "local"


def test_the_session_file_may_name_another_place_which_is_this_machine_s_own() -> None:
    text = DEMO.read_text(encoding="utf-8")
    session = parse_session(text + '\n[recorder]\ndirectory = "kept"\nkeep_s = 60.0\n', DEMO)
    assert session.recorder == RecorderSettings(str(DEMO.parent / "kept"), 60.0)
    assert recorder_folder(session, "remote") == DEMO.parent / "kept" / "demo" / "remote"
    assert session.digest == load_session(DEMO).digest
    assert replace(session, recorder=RecorderSettings()).recorder.keep_s == 3600.0


def test_incident_states_are_states() -> None:
    assert "FAULT" in INCIDENT_STATES
    assert set(INCIDENT_STATES) <= set(State.__members__) | {"EMERGENCY_STOP"}
