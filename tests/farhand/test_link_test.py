"""`farhand link-test` between two processes on loopback."""

import json
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from channel.delay import TraceDelay
from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.security.identity import Identity
from tests.loopback.secured import make_keys, write_session
from tests.ports import free_port
from tests.running import farhand, running

pytestmark = pytest.mark.patient

ROOT = Path(__file__).parents[2]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """The demo's session on ports of its own."""
    text = (ROOT / "experiments" / "demo.toml").read_text(encoding="utf-8")
    remote, local = free_port(), free_port()
    path = tmp_path / "session.toml"
    path.write_text(text.replace("7447", str(remote)).replace("7448", str(local)), encoding="utf-8")
    return path


def ask(session: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return farhand("link-test", session, *arguments)


def test_both_ends_measure_the_path_and_keep_its_delays(session: Path, tmp_path: Path) -> None:
    with running("farhand", "link-test", str(session), "--answer") as answering:
        asked = ask(
            session, "--duration", "3", "--rate", "1000", "--rate", "200",
            "--save", str(tmp_path / "kept"), "--json",
        )  # fmt: skip
        assert answering.poll() is None
    assert asked.returncode in (0, 1), asked.stderr  # 1: this machine was too busy for it
    told = json.loads(asked.stdout)
    assert [one["rate_hz"] for one in told["rates"]] == [1000, 200]
    for one in told["rates"]:
        assert 0.0 < one["round_trip"]["p50_s"] < 0.1
        assert one["round_trip"]["p50_s"] <= one["loop"]["p50_s"] + 0.002
        assert one["loop"]["p50_s"] <= one["bound"]["p50_s"]
        for way in ("to_remote", "to_local"):
            # a site that is late sends less, never more
            assert 0.3 * 1.5 * one["rate_hz"] < one[way]["sent"] < 1.2 * 1.5 * one["rate_hz"]
            assert one[way]["lost"] < 0.5
    # 200 a second, each on the way for next to no time: the loop waits for the packets
    assert told["rates"][1]["loop"]["p50_s"] > 0.003
    assert told["certified_round_trip_s"] == pytest.approx(0.298)
    for name in ("local_to_remote", "remote_to_local"):
        delay = TraceDelay(str(tmp_path / "kept" / f"{name}.csv"))
        assert 0.0 <= delay.at(0.5, np.random.default_rng(0)) <= delay.bound_s < 2.0


def test_a_place_that_is_taken_is_told(session: Path) -> None:
    port = session.read_text(encoding="utf-8").split('local_listen = "')[1].split('"')[0]
    node = ZenohNode(ZenohSettings(listen=(port,)))
    try:
        asked = ask(session)
    finally:
        node.close()
    assert asked.returncode == 2
    assert port in asked.stderr
    assert "a site, or another link test" in asked.stderr


def test_a_site_that_runs_is_told_and_a_rate_that_no_site_has(session: Path) -> None:
    assert "must divide loop.rate_hz = 1000" in ask(session, "--rate", "300").stderr
    with running("remote_site", str(session), "--no-record"):
        time.sleep(1.0)
        asked = ask(session)
    assert asked.returncode == 2
    assert "the remote site of this session is running" in asked.stderr


def test_another_session_file_at_the_other_end_is_told(session: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    text = session.read_text(encoding="utf-8")
    other.write_text(text.replace("seed = 1", "seed = 2"), encoding="utf-8")
    with running("farhand", "link-test", str(other), "--answer"):
        asked = ask(session)
    assert asked.returncode == 2
    assert "ANOTHER session file" in asked.stderr


RATE_HZ = 200
NETWORKS = {"directly": None, "router": "tls", "router, datagrams": "quic"}


def secured(folder: Path, relay: str | None, *people: str) -> Path:
    """A session with certificates and a loop of 1 kHz that sends 200 times a second."""
    make_keys(folder / "keys", map(Identity, ("remote", "router", *(people or ("local",)))))
    remote, local = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    network: dict[str, object] = {
        "remote_listen": remote,
        "local_listen": local,
        "local_connect": remote,
    }
    if relay is not None:
        network = {"router": f"{relay}/127.0.0.1:{free_port()}"}
    path = write_session(folder / "session.toml", folder / "keys", **network)
    text = path.read_text(encoding="utf-8").replace("rate_hz = 250", "rate_hz = 1000")
    text = text.replace('injection = "off"', f'injection = "off"\nsend_rate_hz = {RATE_HZ}')
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("relay", NETWORKS.values(), ids=NETWORKS)
def test_with_certificates_at_rates_that_reach_the_other_end(
    tmp_path: Path, relay: str | None
) -> None:
    session = secured(tmp_path, relay)
    with ExitStack() as stack:
        if relay is not None:
            stack.enter_context(running("farhand", "router", str(session)))
        stack.enter_context(running("farhand", "link-test", str(session), "--answer"))
        asked = ask(session, "--duration", "4", "--json")
    assert asked.returncode in (0, 1), asked.stderr
    told = json.loads(asked.stdout)
    rates = [1000, 500, 250, 200, 100] if relay is None else [250, 200, 100]
    assert [one["rate_hz"] for one in told["rates"]] == rates
    assert ("rates up to 400 Hz: the router" in asked.stderr) == (relay is not None)
    assert told["own_rate_hz"] == RATE_HZ
    for one in told["rates"]:
        assert 0.0 < one["round_trip"]["p50_s"] < 0.1
        for way in ("to_remote", "to_local"):
            assert one[way]["lost"] < 0.1  # a busy machine's; the router's limit would take half


def test_a_rate_that_a_router_thins_is_refused_with_its_limits(tmp_path: Path) -> None:
    asked = ask(secured(tmp_path, "tls"), "--rate", "1000")
    assert asked.returncode == 2
    assert "--rate 1000" in asked.stderr
    assert "lets 800 packets a second through" in asked.stderr
    assert "up to 400 Hz" in asked.stderr


def test_operators_measure_each_with_his_own_keys(tmp_path: Path) -> None:
    session = secured(tmp_path, "tls", "operator.alice", "operator.bob")
    unsaid = ask(session, "--answer")
    assert unsaid.returncode == 2
    assert "--as NAME, of alice, bob" in unsaid.stderr
    with (
        running("farhand", "router", str(session)),
        running("farhand", "link-test", str(session), "--answer", "--as", "bob"),
    ):
        asked = ask(session, "--as", "bob", "--duration", "1", "--rate", "100", "--json")
    assert asked.returncode in (0, 1), asked.stderr
    assert json.loads(asked.stdout)["rates"][0]["round_trip"]["p50_s"] > 0.0
