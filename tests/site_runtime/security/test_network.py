"""How a session's parties meet: endpoints, plain text, certificates, access control."""

import shutil
from datetime import timedelta
from pathlib import Path

import pytest

from channel.zenoh_link import ZenohSettings
from site_runtime.keys import (
    SiteId,
    claim_key,
    lease_key,
    offer_key,
    state_key,
    telemetry_key,
)
from site_runtime.security.access import access_control, grants
from site_runtime.security.authority import Authority, create_authority
from site_runtime.security.endpoints import Endpoint
from site_runtime.security.identity import ROUTER, SITES, Identity, Role, SecurityError
from site_runtime.security.network import meet_as_observer, meet_as_router, meet_as_site
from site_runtime.session import Session, SessionFileError, load_session, parse_session

DEMO = Path(__file__).parents[3] / "experiments" / "demo.toml"
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
EYE = Identity("dashboard")
MTLS = 'security = "mtls"\nkeys = "keys"\n'
SECURE = MTLS + (
    'local_listen = "tls/127.0.0.1:7448"\nremote_listen = "tls/127.0.0.1:7447"\n'
    'local_connect = "tls/127.0.0.1:7447"\n'
)


def session(folder: Path, network: str) -> Session:
    text = DEMO.read_text(encoding="utf-8")
    before, _, after = text.partition("[network]\n")
    _, _, rest = after.partition("\n\n")
    return parse_session(f"{before}[network]\n{network}\n{rest}", folder / "session.toml")


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    authority = create_authority(tmp_path / "keys", "trial")
    for identity in (*SITES.values(), ROUTER, EYE):
        authority.issue(identity, ["127.0.0.1"])
    return authority


@pytest.mark.parametrize(
    ("text", "host", "within"),
    [
        ("tcp/127.0.0.1:7447", "127.0.0.1", True),
        ("tcp/127.8.9.1:7447?rel=1#iface=lo", "127.8.9.1", True),
        ("udp/[::1]:7447", "::1", True),
        ("tcp/localhost:7447", "localhost", True),
        ("unixsock-stream//tmp/x", "", True),
        ("tcp/0.0.0.0:7447", "0.0.0.0", False),  # noqa: S104
        ("tcp/[::]:7447", "::", False),
        ("tcp/192.168.1.2:7447", "192.168.1.2", False),
        ("tcp/localhost.example:7447", "localhost.example", False),
        ("udp/10.0.0.1:1?x=127.0.0.1:1", "10.0.0.1", False),
        ("ws/arm.example:80", "arm.example", False),
        ("tcp/127.0.0.1.example:7447", "127.0.0.1.example", False),
        ("nonsense", "", False),
    ],
)
def test_where_an_endpoint_leads(text: str, host: str, within: bool) -> None:
    endpoint = Endpoint("--listen", text)
    assert endpoint.within_the_machine is within
    if "sock" not in text:
        assert endpoint.host == host


@pytest.mark.parametrize("place", ["tcp/0.0.0.0:7447", "udp/arm.example:7447", "ws/10.0.0.1:80"])
@pytest.mark.parametrize("by", ["session", "--listen", "--connect"])
def test_plain_text_beyond_the_machine_is_refused_unless_allowed(
    tmp_path: Path, place: str, by: str
) -> None:
    key = f'remote_listen = "{place}"\n' if by == "session" else ""
    listen = [place] if by == "--listen" else None
    connect = [place] if by == "--connect" else None
    with pytest.raises(SecurityError, match="plain text") as caught:
        meet_as_site(session(tmp_path, key), REMOTE, listen, connect)
    assert place in str(caught.value)
    assert ("network.remote_listen" if by == "session" else by) in str(caught.value)
    allowed = meet_as_site(
        session(tmp_path, f"{key}allow_plaintext = true\n"), REMOTE, listen, connect
    )
    assert len(allowed.warnings) == 1
    assert place in allowed.warnings[0]


def test_an_observer_is_refused_plain_text_too(tmp_path: Path) -> None:
    with pytest.raises(SecurityError, match="--connect"):
        meet_as_observer(session(tmp_path, ""), EYE, ["tcp/10.0.0.1:7447"])


def test_a_session_on_one_machine_needs_nothing_and_is_told_nothing(tmp_path: Path) -> None:
    for site in SiteId:
        meeting = meet_as_site(session(tmp_path, ""), site)
        assert meeting.warnings == ()
        assert meeting.settings.configuration == {}
        assert meeting.credentials is None
    expected = ZenohSettings(
        listen=("tcp/127.0.0.1:7448",), connect=("tcp/127.0.0.1:7447",), lease_ms=500, tier=1
    )
    assert meet_as_site(session(tmp_path, ""), LOCAL).settings == expected


@pytest.mark.parametrize("by", ["session", "--listen", "--connect"])
def test_with_certificates_no_endpoint_is_without(
    tmp_path: Path, authority: Authority, by: str
) -> None:
    plain = "tcp/127.0.0.1:7447"
    network = SECURE + "allow_plaintext = true\n"
    if by == "session":
        network = network.replace('remote_listen = "tls', 'remote_listen = "tcp')
    listen = [plain] if by == "--listen" else None
    connect = [plain] if by == "--connect" else None
    with pytest.raises(SecurityError, match="every endpoint is tls/ or quic/"):
        meet_as_site(session(tmp_path, network), REMOTE, listen, connect)


def test_what_no_certificate_could_name_is_not_dialled(
    tmp_path: Path, authority: Authority
) -> None:
    network = SECURE.replace('_listen = "tls/127.0.0.1', '_listen = "tls/0.0.0.0')
    loaded = session(tmp_path, network)
    meet_as_site(loaded, REMOTE)
    with pytest.raises(SecurityError, match="--connect"):
        meet_as_observer(loaded, EYE)
    meet_as_observer(loaded, EYE, ["tls/10.0.0.1:7447"])


def test_mutual_tls_asks_for_everything(tmp_path: Path, authority: Authority) -> None:
    for site in SiteId:
        meeting = meet_as_site(session(tmp_path, SECURE), site)
        tls = meeting.settings.configuration["transport/link/tls"]
        assert tls["enable_mtls"] is True
        assert tls["verify_name_on_connect"] is True
        assert tls["close_link_on_expiration"] is True
        paths = [value for value in tls.values() if isinstance(value, str)]
        assert len(paths) == 5
        assert all(Path(path).parent == authority.folder / site.label for path in paths)


def test_a_certificate_near_its_end_is_told(tmp_path: Path, authority: Authority) -> None:
    loaded = session(tmp_path, SECURE)
    assert meet_as_site(loaded, REMOTE).warnings == ()
    authority.issue(SITES[REMOTE], (), life=timedelta(days=29, hours=1))
    (warning,) = meet_as_site(loaded, REMOTE).warnings
    assert "remote-1 expires in 29 days" in warning
    assert "farhand keys renew" in warning


def test_the_digest_knows_nothing_of_security(tmp_path: Path) -> None:
    digests = {
        session(tmp_path, network).digest
        for network in (
            "",
            SECURE,
            MTLS + 'router = "quic/relay.example:7447"',
            MTLS + 'packets_connect = "udp/robot.example:7449"',
        )
    }
    assert len(digests) == 1


@pytest.mark.parametrize(
    ("network", "words"),
    [
        ('security = "mtls"', ["network.keys", "farhand keys"]),
        ('zenoh_config = "x.json5"\n' + MTLS, ["network.security", "zenoh_config"]),
        (
            'zenoh_config = "x.json5"\nrouter = "tls/a:1"',
            ["network.router", "zenoh_config"],
        ),
        ('security = "tls"', ["network.security"]),
        ('router = "7447"', ["network.router", "Zenoh endpoint"]),
        (MTLS + 'packets_listen = "tcp/127.0.0.1:1"', ["network.packets_listen", "udp/"]),
        (MTLS + 'packets_connect = "quic/127.0.0.1:1"', ["network.packets_connect", "udp/"]),
        ('packets_connect = "udp/127.0.0.1:1"', ["network.packets_connect", '"mtls"']),
    ],
)
def test_contradictions_of_the_file(tmp_path: Path, network: str, words: list[str]) -> None:
    with pytest.raises(SessionFileError) as caught:
        session(tmp_path, network)
    for word in words:
        assert word in str(caught.value)


def test_at_a_router_everybody_dials_it_and_only_it_listens(
    tmp_path: Path, authority: Authority
) -> None:
    loaded = session(tmp_path, MTLS + 'router = "quic/127.0.0.1:7447"\n')
    meetings = [meet_as_site(loaded, site) for site in SiteId] + [meet_as_observer(loaded, EYE)]
    for meeting, region in zip(meetings, ("local", "remote", "observer"), strict=True):
        assert meeting.settings.listen == ()
        assert meeting.settings.connect == ("quic/127.0.0.1:7447?mixed_rel=1",)
        assert meeting.settings.configuration["region_name"] == region
        assert meeting.settings.tier == 0
    relay = meet_as_router(loaded)
    assert relay.settings.listen == ("quic/127.0.0.1:7447?mixed_rel=1",)
    assert relay.settings.connect == ()
    elsewhere = meet_as_router(loaded, ["quic/0.0.0.0:7447"])
    assert elsewhere.settings.listen == ("quic/0.0.0.0:7447?mixed_rel=1",)
    assert relay.settings.configuration["mode"] == "router"
    assert relay.settings.tier == 1


def test_a_session_without_a_router_has_none(tmp_path: Path) -> None:
    with pytest.raises(SecurityError, match=r"network\.router"):
        meet_as_router(session(tmp_path, ""))


def test_a_party_whose_names_are_all_revoked_has_no_subject() -> None:
    """To Zenoh a subject without names would be everybody."""
    control = access_control(grants("s", SITES[REMOTE], False), {EYE: "observer.dashboard-1"})
    assert [subject["id"] for subject in control["subjects"]] == ["observer"]
    assert control["default_permission"] == "deny"
    for subject in control["subjects"]:
        assert subject["cert_common_names"]


@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize("routed", [False, True])
def test_nobody_says_what_is_another_partys(routed: bool, sealed: bool) -> None:
    """Of every grant of every party: poses only of their site, and to nobody but the other."""
    for own in (*SITES.values(), EYE, *([ROUTER] if routed else [])):
        for role, grant in grants("s", own, routed, sealed=sealed).items():
            for site in SiteId:
                rows = telemetry_key("s", site)
                poses = offer_key("s", site) if sealed else state_key("s", site)
                speaks = role is Role.ROUTER or role == site.label
                assert speaks or poses not in grant.says
                assert speaks or rows not in grant.says
                assert role is not Role.OBSERVER or poses not in grant.hears
            assert role is not Role.OBSERVER or grant.says == ()
            assert not any("**" in key for key in (*grant.says, *grant.hears))


PEOPLE = (Identity("operator.alice"), Identity("operator.bob"), Identity("supervisor.carol"))


@pytest.mark.parametrize("routed", [False, True])
def test_operators_say_nothing_in_each_others_name(routed: bool) -> None:
    for own in (*SITES.values(), EYE, *PEOPLE, *([ROUTER] if routed else [])):
        for party, grant in grants("s", own, routed, PEOPLE).items():
            assert party is not Role.LOCAL
            for one in PEOPLE:
                keys = {
                    claim_key("s", one.person),
                    state_key("s", LOCAL, one.person),
                    telemetry_key("s", LOCAL, one.person),
                }
                assert party in (one, Role.ROUTER) or not keys & set(grant.says)
            assert lease_key("s") not in grant.says or party in (Role.REMOTE, Role.ROUTER)
            assert party is not Role.OBSERVER or grant.says == ()
    for one in PEOPLE:  # what a node may be asked to say is what it may say
        (own_grant,) = [
            grant
            for party, grant in grants("s", one, routed, PEOPLE).items()
            if party in (Role.ROUTER, Role.REMOTE)
        ]
        others = [key for key in own_grant.hears if f"/{one.person}" not in key]
        assert others == []


def test_each_person_is_a_subject_of_access_control() -> None:
    allowed = {one: f"{one.name}-1" for one in PEOPLE} | {SITES[LOCAL]: "local-1"}
    control = access_control(grants("s", SITES[REMOTE], False, PEOPLE), allowed)
    subjects = {one["id"]: one["cert_common_names"] for one in control["subjects"]}
    assert subjects == {one.name: [f"{one.name}-1"] for one in PEOPLE}


def test_who_is_at_the_local_site(tmp_path: Path, authority: Authority) -> None:
    loaded = session(tmp_path, SECURE)
    assert meet_as_site(loaded, LOCAL).person is None
    for one in PEOPLE[:2]:
        authority.issue(one, ["127.0.0.1"])
    with pytest.raises(SecurityError, match="--as NAME, of alice, bob"):
        meet_as_site(loaded, LOCAL)
    meeting = meet_as_site(loaded, LOCAL, operator="bob")
    assert (meeting.person, meeting.people) == ("bob", PEOPLE[:2])
    with pytest.raises(SecurityError, match="no keys of such an operator"):
        meet_as_site(loaded, LOCAL, operator="eve")
    with pytest.raises(SecurityError, match="an operator is at the local site"):
        meet_as_site(loaded, REMOTE, operator="bob")
    shutil.rmtree(authority.folder / "operator.alice")
    with pytest.raises(SecurityError, match="say who you are"):
        meet_as_site(loaded, LOCAL)
    (authority.folder / "local").rename(tmp_path / "local")
    assert meet_as_site(loaded, LOCAL).person == "bob"  # the only one here
    with pytest.raises(SecurityError, match="nobody could tell who it is"):
        meet_as_site(session(tmp_path, ""), LOCAL, operator="bob")


def test_the_keys_of_a_nameless_local_site_end_with_the_first_operator(
    tmp_path: Path, authority: Authority
) -> None:
    authority.issue(PEOPLE[0], ["127.0.0.1"])
    shutil.rmtree(authority.folder / PEOPLE[0].name)  # on another machine
    with pytest.raises(SecurityError, match="not obeyed any more"):
        meet_as_site(session(tmp_path, SECURE), LOCAL)


LISTEN, CONNECT = 'packets_listen = "udp/0.0.0.0:7449"\n', 'packets_connect = "udp/10.0.0.1:7449"\n'
ROUTED = MTLS + 'router = "quic/127.0.0.1:7447"\n'


@pytest.mark.parametrize("routed", [False, True])
def test_sealed_packets_have_a_node_of_their_own(
    tmp_path: Path, authority: Authority, routed: bool
) -> None:
    loaded = session(tmp_path, (ROUTED if routed else SECURE) + LISTEN + CONNECT)
    assert meet_as_observer(loaded, EYE, ["tls/127.0.0.1:7447"]).packets is None
    meetings = {site: meet_as_site(loaded, site) for site in SiteId}
    for site, meeting in meetings.items():
        assert meeting.packets is not None
        listens = site is REMOTE and not routed
        assert meeting.packets.listen == (("udp/0.0.0.0:7449",) if listens else ())
        assert meeting.packets.connect == (() if listens else ("udp/10.0.0.1:7449",))
        assert meeting.packets.configuration.get("region_name") == (site.label if routed else None)
        control = meeting.packets.configuration["access_control"]
        assert control["default_permission"] == "deny"
        assert [subject["link_protocols"] for subject in control["subjects"]] == [["udp"]]
        keys = {
            (rule["id"], key, message)
            for rule in control["rules"]
            for key in rule["key_exprs"]
            for message in rule["messages"]
        }
        own, peer = state_key("demo", site), state_key("demo", site.peer)
        assert keys == {
            ("says", peer, "put"),
            ("says-asked", peer, "declare_subscriber"),
            ("hears", own, "put"),
            ("hears-asked", own, "declare_subscriber"),
        }
        assert "udp" not in str(meeting.settings)  # nor anything of them on the other
        assert f"'{own}'" not in str(meeting.settings.configuration)
        assert offer_key("demo", site) in str(meeting.settings.configuration)
        assert meeting.warnings == ()  # sealed: not in the clear
    if routed:
        relay = meet_as_router(loaded)
        assert relay.packets is not None
        assert relay.packets.listen == ("udp/0.0.0.0:7449",)
        assert relay.packets.configuration["mode"] == "router"
        assert "telemetry" not in str(relay.packets.configuration)
        assert f"'{state_key('demo', LOCAL)}'" not in str(
            relay.settings.configuration["access_control"]
        )


@pytest.mark.parametrize(
    ("network", "who", "key"),
    [
        (SECURE + LISTEN, LOCAL, "packets_connect"),
        (SECURE + CONNECT, REMOTE, "packets_listen"),
        (ROUTED + LISTEN, REMOTE, "packets_connect"),
        (ROUTED + CONNECT, None, "packets_listen"),
    ],
)
def test_who_seals_packets_says_where_they_go(
    tmp_path: Path, authority: Authority, network: str, who: SiteId | None, key: str
) -> None:
    def meet(loaded: Session) -> object:
        return meet_as_router(loaded) if who is None else meet_as_site(loaded, who)

    with pytest.raises(SecurityError, match=rf"network\.{key} is missing"):
        meet(session(tmp_path, network))
    given = LISTEN if key == "packets_listen" else CONNECT
    meet(session(tmp_path, network + given))


def test_packets_are_not_dialled_at_every_address(tmp_path: Path, authority: Authority) -> None:
    with pytest.raises(SecurityError, match="packets_connect"):
        meet_as_site(session(tmp_path, SECURE + LISTEN.replace("listen", "connect")), LOCAL)


def test_operators_hear_and_say_sealed_packets_each_in_his_own_name(
    tmp_path: Path, authority: Authority
) -> None:
    for one in PEOPLE[:2]:
        authority.issue(one, ["127.0.0.1"])
    loaded = session(tmp_path, SECURE + LISTEN + CONNECT)
    bob = meet_as_site(loaded, LOCAL, operator="bob").packets
    remote = meet_as_site(loaded, REMOTE).packets
    assert bob is not None
    assert remote is not None
    assert "alice" not in str(bob.configuration)
    for one in ("alice", "bob"):
        assert state_key("demo", LOCAL, one) in str(remote.configuration)
    assert state_key("demo", LOCAL) not in str(remote.configuration)


def test_the_demo_stays_as_it_is() -> None:
    assert load_session(DEMO).network.security == "none"
