"""`farhand router`: two daemons that meet at a relay, and those who try through it."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing

import pytest
from prometheus_client.parser import text_string_to_metric_families

from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import SiteId, state_key
from site_runtime.link_keeper import ASK_S, UNHEARD_S
from site_runtime.security.network import meet_as_site
from tests.loopback.secured import FORGED, NAME, RATE_HZ, ROOT, SecuredPair, tls, until
from tests.ports import free_port

pytestmark = pytest.mark.patient
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredPair]:
    pair = SecuredPair(tmp_path_factory.mktemp("relayed"), relay="quic")
    try:
        # the relay comes last: nobody waits for it to start
        pair.start("remote", "local")
        pair.watch()
        pair.start("router", options=("--metrics", "0"))
        pair.until_engaged()
        yield pair
    finally:
        pair.close()


def behind(pair: SecuredPair, name: str, region: str) -> ZenohNode:
    """A node at the relay that enforces nothing itself."""
    configuration = tls(pair.keys / name) | {"region_name": region}
    dialled = f"{pair.relay}?mixed_rel=1"
    return ZenohNode(ZenohSettings(connect=(dialled,), configuration=configuration))


def test_the_relay_tells_who_is_connected(pair: SecuredPair) -> None:
    for name in ("local-1", "remote-1", "observer.dashboard-1"):
        until(lambda name=name: f"{name} connected" in pair.text("router"), f"{name} told of")


def scraped(pair: SecuredPair) -> dict[str, dict[tuple[str, ...], float]]:
    """The relay's own metrics: by name, by the values of their labels but the session's."""
    url = re.search(r"metrics at (http://127\S+)", pair.text("router"))
    assert url is not None
    with urllib.request.urlopen(url[1], timeout=5) as answer:  # noqa: S310 - our own
        text = answer.read().decode()
    found: dict[str, dict[tuple[str, ...], float]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            assert sample.labels.pop("session") == NAME
            found.setdefault(sample.name, {})[tuple(sample.labels.values())] = sample.value
    return found


def test_the_relay_counts_what_passes_and_who_is_there(pair: SecuredPair) -> None:
    names = {("local-1",), ("remote-1",), ("observer.dashboard-1",)}
    until(lambda: set(scraped(pair)["farhand_relay_connected"]) == names, "all connected")
    before = scraped(pair)
    assert before["farhand_relay_connections"] == {(): 3}
    page = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
    told = set(re.findall(r"^\| `(farhand_relay_\w+)`", page, re.MULTILINE))
    assert told == {name for name in before if not name.endswith("_created")}
    time.sleep(1.0)
    after = scraped(pair)["farhand_relay_packets_total"]
    assert set(after) == {("local",), ("remote",)}
    for party, count in after.items():
        passed = count - before["farhand_relay_packets_total"][party]
        assert 0.3 * RATE_HZ < passed < 3 * RATE_HZ


def test_a_relay_whose_metrics_have_no_port_says_so(pair: SecuredPair) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = subprocess.run(
            [
                *(sys.executable, "-m", "farhand", "router", str(pair.file)),
                *("--listen", f"tls/127.0.0.1:{free_port()}", "--metrics", str(port)),
            ],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 2
    assert f"metrics cannot be served on 127.0.0.1:{port}" in done.stderr


def test_a_site_speaks_through_the_relay_in_its_own_name(pair: SecuredPair) -> None:
    """The control of the next test."""
    with closing(behind(pair, "remote", "remote")) as node:
        until(lambda: node.partners() == ("router-1",), "a connection")
        assert pair.refused_while(node, REMOTE) > 20


@pytest.mark.parametrize(
    ("thief", "speaker"),
    [("local", REMOTE), ("remote", LOCAL), ("dashboard", LOCAL), ("dashboard", REMOTE)],
)
def test_a_certificate_does_not_speak_for_others_through_the_relay(
    pair: SecuredPair, thief: str, speaker: SiteId
) -> None:
    with closing(behind(pair, thief, region=speaker.label)) as node:  # pretending to be there
        ear = node.subscriber(state_key(NAME, speaker), 100)
        until(lambda: node.partners() == ("router-1",), "a connection")
        assert pair.refused_while(node, speaker) == 0
        if thief == "dashboard":
            assert {payload for _, payload in ear.receive()} <= {FORGED}  # its own voice


def test_what_is_longer_than_any_packet_is_not_relayed(pair: SecuredPair) -> None:
    before = pair.rejected(LOCAL)
    with closing(behind(pair, "remote", "remote")) as node:
        publish = node.publisher(state_key(NAME, REMOTE))
        until(lambda: node.partners() == ("router-1",), "a connection")
        for _ in range(50):
            publish(bytes(513))
            time.sleep(0.01)
        assert pair.rejected(LOCAL) == before
        until(lambda: (publish(bytes(512)), pair.rejected(LOCAL) > before)[1], "shorter ones")


def test_a_flood_through_the_relay_is_thinned(pair: SecuredPair) -> None:
    """To four times the rate that the session has."""
    before = pair.rejected(LOCAL)
    with closing(behind(pair, "remote", "remote")) as node:
        publish = node.publisher(state_key(NAME, REMOTE))
        until(lambda: node.partners() == ("router-1",), "a connection")
        until(lambda: (publish(FORGED), pair.rejected(LOCAL) > before)[1], "what is let through")
        before = pair.rejected(LOCAL)
        begin_s = time.monotonic()
        for _ in range(10_000):
            publish(FORGED)
        passed = pair.rejected(LOCAL) - before
        assert passed <= 4 * RATE_HZ * (time.monotonic() - begin_s) + 10


def test_the_relay_tells_a_site_whether_its_peer_is_there_and_one_that_stands_still_nothing(
    pair: SecuredPair,
) -> None:
    """With the access control of both; a site that is told of none waits and stays connected."""
    with closing(ZenohNode(meet_as_site(pair.session, LOCAL).settings)) as node:
        link = node.link(state_key(NAME, LOCAL), state_key(NAME, REMOTE))
        until(lambda: node.partners() == ("router-1",), "a connection")
        until(lambda: link.ask_for_peer(2.0) is True, "told of the remote site")
        pair.kill("remote")
        until(lambda: link.ask_for_peer(2.0) is False, "told of its absence")
        time.sleep(2.5 * (UNHEARD_S + ASK_S))
        assert "the connection is opened anew" not in pair.text("local")
        assert pair.text("router").count("local-1 gone") == 0
        pair.signal("router", signal.SIGSTOP)
        try:
            assert link.ask_for_peer(0.5) is None  # sooner than any lease is over
        finally:
            pair.signal("router", signal.SIGCONT)
    pair.start("remote")
    pair.until_engaged()


def test_a_relay_that_was_killed_is_replaced_and_the_pair_engages_again(pair: SecuredPair) -> None:
    """First by what a zenohd would be told, given to a session of Zenoh's, then by its own."""
    printed = subprocess.run(
        [sys.executable, "-m", "farhand", "router", str(pair.file), "--print-config"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    configuration = json.loads(printed)
    assert configuration["mode"] == "router"
    assert configuration["access_control"]["default_permission"] == "deny"
    file = pair.folder / "zenohd.json5"
    file.write_text(printed, encoding="utf-8")
    pair.kill("router")
    with closing(ZenohNode(ZenohSettings(config_file=str(file)))) as relay:
        until(lambda: {"local-1", "remote-1"} <= set(relay.partners()), "both at the relay")
        pair.until_engaged()
    pair.start("router")
    pair.until_engaged()
