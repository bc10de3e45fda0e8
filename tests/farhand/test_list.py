"""`farhand list` and `farhand lease` where nobody shows a certificate."""

import json
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
from tests.ports import free_port

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
