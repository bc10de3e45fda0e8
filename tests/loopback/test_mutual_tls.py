"""Nobody uninvited: two daemons with certificates, and all who try without the right one."""

import json
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import SiteId, state_key
from site_runtime.security.authority import create_authority
from site_runtime.security.identity import Identity
from site_runtime.security.network import meet_as_site
from site_runtime.session import load_session
from tests.loopback.secured import (
    FORGED,
    LOOPBACK,
    SecuredPair,
    dialling,
    ended,
    make_keys,
    tls,
    until,
    write_session,
)
from tests.ports import free_port

pytestmark = pytest.mark.patient
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
REFUSED_S = 1.0  # longer than a handshake on a crowded machine; Zenoh goes on trying


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredPair]:
    """Engaged daemons; the remote's first certificate has been revoked, its second is in use."""
    pair = SecuredPair(tmp_path_factory.mktemp("secured"))
    pair.steal("remote")
    pair.authority.revoke(Identity("remote"))
    pair.authority.issue(Identity("remote"), LOOPBACK)
    try:
        pair.start("remote", "local")
        pair.watch()
        pair.until_engaged()
        yield pair
    finally:
        pair.close()


def never_connects(node: ZenohNode) -> bool:
    try:
        until(lambda: bool(node.partners()), "a connection", REFUSED_S)
    except AssertionError:
        return True
    return False


def test_a_dashboard_with_its_certificate_sees_both_sites_engaged(pair: SecuredPair) -> None:
    pair.until_engaged()


@pytest.mark.parametrize("speaker", SiteId, ids=lambda site: site.label)
def test_what_would_arrive_of_a_forged_packet_is_seen(pair: SecuredPair, speaker: SiteId) -> None:
    """The control: with a site's own certificate it gets as far as the other's checks."""
    with closing(dialling(pair.keys / speaker.label, pair.endpoints[speaker.peer])) as node:
        until(lambda: bool(node.partners()), "a connection")
        assert pair.refused_while(node, speaker) > 20


@pytest.mark.parametrize(
    "thief", ["local", "dashboard", "revoked remote", "router", "unheard-of observer"]
)
def test_a_certificate_does_not_say_what_is_not_its_own(pair: SecuredPair, thief: str) -> None:
    if thief == "revoked remote":
        folder = pair.stolen / "remote"
    elif thief == "unheard-of observer":
        pair.authority.issue(Identity("eve"), ())
        folder = pair.keys / "eve"
    else:
        folder = pair.keys / thief
    with closing(dialling(folder, pair.endpoints[LOCAL])) as node:
        until(lambda: node.partners() == ("local-1",), "a connection")  # so far by TLS alone
        assert pair.refused_while(node, REMOTE) == 0


def test_a_dashboard_commands_neither_site_and_hears_no_packet(pair: SecuredPair) -> None:
    places = [pair.endpoints[site] for site in SiteId]
    with closing(dialling(pair.keys / "dashboard", *places)) as node:
        ears = [node.subscriber(state_key("secured", site), 100) for site in SiteId]
        until(lambda: node.partners() == ("local-1", "remote-2"), "both connections")
        for speaker in SiteId:
            assert pair.refused_while(node, speaker) == 0
        heard = [payload for ear in ears for _, payload in ear.receive()]
        assert set(heard) <= {FORGED}  # its own voice


@pytest.mark.parametrize("who", ["another authority", "nobody", "plain text"])
def test_who_has_no_certificate_of_this_authority_is_not_connected(
    pair: SecuredPair, who: str, tmp_path: Path
) -> None:
    endpoint = pair.endpoints[LOCAL]
    configuration: dict[str, object] = {}
    if who == "another authority":
        make_keys(tmp_path / "keys")
        # it knows whom it talks to: only its own certificate is wrong
        configuration = tls(tmp_path / "keys" / "remote", trust=pair.keys / "remote")
    elif who == "nobody":
        configuration = tls(None, trust=pair.keys / "remote")
    else:
        endpoint = endpoint.replace("tls/", "tcp/")
    settings = ZenohSettings(connect=(endpoint,), configuration=configuration)
    with closing(ZenohNode(settings)) as node:
        assert never_connects(node)


@pytest.mark.parametrize(
    "impostor", ["another authority", "dashboard", "another host", "revoked remote", "local"]
)
def test_who_listens_in_the_remotes_place_is_not_heard(impostor: str, tmp_path: Path) -> None:
    """What a site dials may be anybody: a name server or a route that lies."""
    keys = tmp_path / "keys"
    authority = make_keys(keys)
    folder = keys / "remote"
    if impostor == "another authority":
        make_keys(tmp_path / "other")
        folder = tmp_path / "other" / "remote"
    elif impostor == "another host":
        other = create_authority(tmp_path / "elsewhere", "x")
        other._certificate, other._key = authority._certificate, authority._key
        other.issue(Identity("remote"), ["robot.example"])
        folder = tmp_path / "elsewhere" / "remote"
    elif impostor == "revoked remote":
        folder = keys / "remote"
        authority.revoke(Identity("remote"))
    else:
        folder = keys / impostor
    endpoint = f"tls/127.0.0.1:{free_port()}"
    file = write_session(
        tmp_path / "session.toml",
        keys,
        local_listen=f"tls/127.0.0.1:{free_port()}",
        local_connect=endpoint,
    )
    session = load_session(file)
    with (
        closing(ZenohNode(ZenohSettings(listen=(endpoint,), configuration=tls(folder)))) as liar,
        closing(ZenohNode(meet_as_site(session, LOCAL).settings)) as node,
    ):
        link = node.link(state_key("secured", LOCAL), state_key("secured", REMOTE))
        mouth = liar.link(state_key("secured", REMOTE), state_key("secured", LOCAL))
        by_tls = impostor in ("revoked remote", "local")
        if by_tls:
            until(lambda: bool(node.partners()), "a connection")
        else:
            assert never_connects(node)
        for _ in range(30):
            mouth.send(FORGED)
            link.send(b"a pose")
            time.sleep(0.01)
        assert link.receive() == []
        assert mouth.receive() == []
        assert not link.peer_present()


def test_a_connection_ends_with_the_certificate_that_opened_it(tmp_path: Path) -> None:
    authority = make_keys(tmp_path / "keys")
    authority.issue(Identity("local"), LOOPBACK, life=timedelta(seconds=4))
    endpoint = f"tls/127.0.0.1:{free_port()}"
    file = write_session(
        tmp_path / "session.toml",
        tmp_path / "keys",
        local_listen=f"tls/127.0.0.1:{free_port()}",
        remote_listen=endpoint,
        local_connect=endpoint,
    )
    session = load_session(file)
    with (
        closing(ZenohNode(meet_as_site(session, REMOTE).settings)) as remote,
        closing(ZenohNode(meet_as_site(session, LOCAL).settings)),
    ):
        until(lambda: remote.partners() == ("local-1",), "a connection")
        until(lambda: remote.partners() == (), "its end")
        assert never_connects(remote)


def test_a_daemon_warns_of_a_certificate_near_its_end_and_refuses_a_wrong_one(
    tmp_path: Path,
) -> None:
    keys = tmp_path / "keys"
    make_keys(keys).issue(Identity("remote"), LOOPBACK, life=timedelta(days=9, hours=1))
    file = write_session(
        tmp_path / "session.toml", keys, remote_listen=f"tls/127.0.0.1:{free_port()}"
    )
    options = ["--duration", "0.2", "--log", "json"]
    code, said = ended(file, REMOTE, *options)
    lines = [json.loads(line) for line in said.splitlines()]
    assert code == 0
    assert [line["level"] for line in lines if "expires in 9 days" in line["text"]] == ["WARN"]
    (keys / "remote" / "private_key.pem").chmod(0o640)
    code, said = ended(file, REMOTE, *options)
    (line,) = [json.loads(line) for line in said.splitlines()]
    assert code == 2
    assert line["level"] == "ERROR"
    assert "open to others" in line["text"]
