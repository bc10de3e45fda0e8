"""`farhand list` and `farhand lease` where nobody shows a certificate."""

import json
import re
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from channel.zenoh_link import ZenohNode, ZenohSettings
from farhand.__main__ import app
from site_runtime.keys import lease_key
from site_runtime.lease_messages import RemoteStatus, encode_status
from tests.loopback.secured import NAME, SecuredPair, until
from tests.ports import free_port
from tests.running import farhand, running

DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A site that tells of two robots, one of them twice, and nonsense."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    over = threading.Event()
    with closing(ZenohNode(ZenohSettings(listen=(endpoint,)))) as node:
        arm, hand = node.publisher(lease_key("arm")), node.publisher(lease_key("hand"))

        def tell() -> None:
            while not over.wait(0.05):
                arm(encode_status(RemoteStatus("arm", "1", "READY", 2, leased=False)))
                arm(
                    encode_status(
                        RemoteStatus("arm", "1", "ENGAGED", 2, leased=False, round_trip_s=0.0123)
                    )
                )
                hand(
                    encode_status(
                        RemoteStatus(
                            "hand",
                            "2",
                            "READY",
                            3,
                            leased=True,
                            holder="alice",
                            held_s=61.0,
                            refused={"bob": "alice holds it"},
                        )
                    )
                )
                hand(b"nonsense")

        thread = threading.Thread(target=tell, daemon=True)
        thread.start()
        yield endpoint
        over.set()
        thread.join()


def run(*words: object) -> tuple[int, str]:
    result = CliRunner(env={"COLUMNS": "160"}).invoke(app, [str(word) for word in words])
    return result.exit_code, result.output


def test_all_robots_at_an_endpoint(endpoint: str) -> None:
    code, said = run("list", endpoint, "--json", "--wait", "1.5")
    assert code == 0, said
    arm, hand = json.loads(said)
    assert (arm["session"], arm["dimension"]) == ("arm", 2)
    assert (arm["holder"], arm["leased"]) == (None, False)
    assert (hand["holder"], hand["held_s"], hand["refused"]) == (
        "alice",
        61.0,
        {"bob": "alice holds it"},
    )
    code, said = run("list", endpoint, "--wait", "1.5")
    assert code == 0, said
    for word in ("whoever is first", "alice", "61 s", "bob", "3-D", "12.3 ms"):
        assert word in said


def test_where_no_robot_is_online() -> None:
    code, said = run("list", "tcp/127.0.0.1:9", "--wait", "0.2")
    assert (code, said) == (1, "no robot is online at tcp/127.0.0.1:9\n")


def test_what_needs_a_session_file_to_be_listed() -> None:
    code, said = run("list", "tls/127.0.0.1:9")
    assert code == 2
    assert "name the session file" in said


@pytest.mark.parametrize("words", [["show"], ["release"], ["claim"], ["take"]])
def test_a_session_without_names_has_no_lease(words: list[str]) -> None:
    code, said = run("lease", *words, DEMO)
    assert code == 2
    assert "whoever comes first is obeyed" in said


def shown(place: object) -> tuple[dict[str, object], str]:
    """What `list` says of the one robot at a place once it is ENGAGED: as JSON and as a table."""
    robot: dict[str, object] = {}

    def engaged() -> bool:
        asked = farhand("list", place, "--json", "--wait", "2")
        robots = json.loads(asked.stdout)
        robot.update(*robots)
        return asked.returncode == 0 and robot["state"] == "ENGAGED"

    until(engaged, "listed as ENGAGED")
    table = farhand("list", place, "--wait", "2", width=160)
    assert table.returncode == 0, table.stderr
    return robot, table.stdout


def complete(robot: dict[str, object], table: str, name: str) -> None:
    assert (robot["session"], robot["state"], robot["dimension"]) == (name, "ENGAGED", 2)
    assert (robot["leased"], robot["holder"], robot["refused"]) == (False, None, {})
    assert 0.0 < robot["round_trip_s"] < 5.0  # type: ignore[operator]
    row = next(line for line in table.splitlines() if name in line and "│" in line)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[:6] == [name, "ENGAGED", "2-D", "whoever is first", "", ""]
    assert re.fullmatch(r"[0-9.]+ ms", cells[6])


@pytest.mark.patient
def test_daemons_without_certificates_by_session_file_and_by_endpoint(tmp_path: Path) -> None:
    remote, local = free_port(), free_port()
    text = DEMO.read_text(encoding="utf-8")
    session = tmp_path / "session.toml"
    session.write_text(
        text.replace("7447", str(remote)).replace("7448", str(local)), encoding="utf-8"
    )
    with (
        running("remote_site", str(session), "--no-record", "--quiet"),
        running("local_site", str(session), "--no-record", "--quiet"),
    ):
        for place in (session, f"tcp/127.0.0.1:{remote}"):
            complete(*shown(place), name="demo")


@pytest.mark.patient
def test_daemons_with_certificates_through_a_router(tmp_path: Path) -> None:
    with closing(SecuredPair(tmp_path, relay="quic")) as pair:
        pair.start("router", "remote", "local")
        complete(*shown(pair.file), name=NAME)
