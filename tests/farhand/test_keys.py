"""`farhand keys`, and what daemons say to keys that they cannot use."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from farhand.__main__ import app
from site_runtime.security.credentials import ALLOWED_FILE, load_credentials, read_allowed
from site_runtime.security.identity import Identity

DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"
NETWORK = """[network]
security = "mtls"
keys = "keys"
router = "quic/relay.example:7447"
remote_listen = "tls/0.0.0.0:7447"
local_connect = "tls/arm.example:7447"
"""


@pytest.fixture
def session(tmp_path: Path) -> Path:
    before, _, after = DEMO.read_text(encoding="utf-8").partition("[network]\n")
    path = tmp_path / "session.toml"
    path.write_text(before + NETWORK + "\n" + after.partition("\n\n")[2], encoding="utf-8")
    return path


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, " ".join(result.output.split())


def test_one_command_makes_everybody(session: Path) -> None:
    code, said = run("keys", session, "--observer", "lab", "--host", "router=198.51.100.7")
    assert code == 0, said
    for name in ("local-1", "remote-1", "router-1", "observer.lab-1"):
        assert name in said
    assert "kept under lock" in said
    folder = session.parent / "keys"
    assert load_credentials(folder, Identity("router")).hosts == ("relay.example", "198.51.100.7")
    assert load_credentials(folder, Identity("remote")).hosts == ("arm.example",)
    assert load_credentials(folder, Identity("lab")).hosts == ()


def test_operators_are_made_instead_of_a_local_site(session: Path) -> None:
    code, said = run("keys", session, "--operator", "alice", "--supervisor", "carol")
    assert code == 0, said
    folder = session.parent / "keys"
    made = {path.name for path in folder.iterdir()}
    assert made == {
        "authority", "operator.alice", "supervisor.carol", "remote", "router", "dashboard"
    }  # fmt: skip
    names = read_allowed(folder / "remote" / ALLOWED_FILE)
    assert {"operator.alice-1", "supervisor.carol-1"} < set(names)
    code, said = run("keys", session, "--operator", "bob")
    assert code == 0, said
    assert not (folder / "local").exists()
    code, said = run("keys", session, "--operator", "carol")
    assert code == 2
    assert "operator or supervisor, not both" in said


def test_once_more_adds_who_is_new_and_leaves_the_others(session: Path) -> None:
    run("keys", session)
    folder = session.parent / "keys"
    before = load_credentials(folder, Identity("remote"))
    code, said = run("keys", session, "--observer", "lab")
    assert code == 0
    assert "remote: is there already" in said
    assert "allowed.json" in said
    assert load_credentials(folder, Identity("remote")).fingerprint == before.fingerprint
    assert "observer.lab-1" in load_credentials(folder, Identity("remote")).allowed


def test_revoke_renew_and_show(session: Path) -> None:
    run("keys", session)
    assert "364 days left" in run("keys", "show", session)[1]
    code, said = run("keys", "revoke", session, "remote")
    assert code == 0
    assert "remote-1 is revoked" in said
    assert "allowed.json" in said
    shown = run("keys", "show", session)[1]
    assert "remote-1: REVOKED" in shown
    assert "local-1: 364 days left" in shown
    code, said = run("keys", "renew", session, "remote", "local")
    assert code == 0
    assert "remote-2" in said
    assert "local-1" in said
    assert "allowed.json" in said
    assert "allowed.json" not in run("keys", "renew", session, "local")[1]  # nothing new in them
    credentials = load_credentials(session.parent / "keys", Identity("remote"))
    assert credentials.fingerprint in run("keys", "show", session)[1]
    allowed = read_allowed(session.parent / "keys" / "router" / ALLOWED_FILE)
    assert "remote-2" in allowed
    assert "remote-1" not in allowed


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--host", "remote"], "NAME=HOST"),
        (["--host", "dashboard=a.example"], "NAME=HOST"),
        (["--host", "other=a.example"], "NAME=HOST"),
        (["--observer", "remote"], "no observer"),
        (["--observer", "A B"], "lower-case"),
    ],
)
def test_a_mistake_makes_nothing(session: Path, words: list[str], said: str) -> None:
    code, output = run("keys", session, *words)
    assert code == 2
    assert said in output
    assert not (session.parent / "keys").exists()


def test_what_is_not_there_is_neither_shown_nor_renewed(session: Path) -> None:
    assert run("keys", "show", session)[0] == 2
    code, said = run("keys", "renew", session, "remote")
    assert code == 2
    assert "only the machine that keeps" in said
    run("keys", session)
    code, said = run("keys", "renew", session, "lab")
    assert code == 2
    assert "there are local, remote, router, dashboard" in said


@pytest.mark.parametrize("command", [["local"], ["remote"], ["router"], ["dashboard"], ["record"]])
def test_nobody_starts_without_his_keys(session: Path, command: list[str]) -> None:
    code, said = run(*command, session, "--duration", "1")
    assert code == 2
    assert "farhand keys" in said


def test_without_its_authority_a_folder_of_keys_is_left_alone(session: Path) -> None:
    run("keys", session)
    folder = session.parent / "keys"
    (folder / "authority").rename(session.parent / "locked away")
    before = {path: path.read_bytes() for path in folder.rglob("*.*")}
    code, said = run("keys", session)
    assert code == 2
    assert "bring it back" in said
    assert {path: path.read_bytes() for path in folder.rglob("*.*")} == before
    assert run("keys", "show", session)[0] == 0
