"""How each party of a session meets the others: endpoints, certificates, access control."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from channel.zenoh_link import ZenohSettings
from site_runtime.keys import (
    SiteId,
    claim_key,
    lease_key,
    offer_key,
    state_key,
    telemetry_key,
)
from site_runtime.security.access import Grant, access_control, grants, packets_control
from site_runtime.security.credentials import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    NEAR,
    Credentials,
    load_credentials,
)
from site_runtime.security.endpoints import Endpoint, in_the_clear
from site_runtime.security.identity import (
    PEOPLE,
    ROUTER,
    SITES,
    Identity,
    Role,
    SecurityError,
)
from site_runtime.security.offer import MOST_OFFER_BYTES
from site_runtime.session import Session

MOST_STATE_BYTES = 512
MOST_TELEMETRY_BYTES = 256 * 1024
MOST_LEASE_BYTES = 16 * 1024
BURST = 4
"""A relay lets through this many times the rate that a site has: delayed packets come in bursts."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """How to open a place in the network, and what people should be told of it first."""

    settings: ZenohSettings
    credentials: Credentials | None
    warnings: tuple[str, ...]
    people: tuple[Identity, ...] = ()
    """Who may be in the place of the local site; nobody in particular if empty."""
    packets: ZenohSettings | None = None
    """The same of a node of its own for sealed packets; None if poses need none."""

    @property
    def person(self) -> str | None:
        """The operator's name that this party has."""
        return None if self.credentials is None else self.credentials.identity.person


def meet_as_site(
    session: Session,
    site: SiteId,
    listen: Sequence[str] | None = None,
    connect: Sequence[str] | None = None,
    operator: str | None = None,
) -> Meeting:
    """Return how a site meets its peer; None leaves the session file's word on endpoints.

    `operator` says who is at the local site; None is the only one whose keys are here.
    """
    network = session.network
    local = site is SiteId.LOCAL
    if operator is not None and not local:
        raise SecurityError(f"--as {operator}: an operator is at the local site, not here")
    if network.router is not None:
        listens, dials = [], [Endpoint("network.router", network.router)]
    else:
        own = "local_listen" if local else "remote_listen"
        listens = [Endpoint(f"network.{own}", getattr(network, own))]
        dials = [Endpoint("network.local_connect", network.local_connect)] if local else []
    return _meet(
        session,
        _at_the_local_site(session, operator) if local else SITES[site],
        listens if listen is None else [Endpoint("--listen", text) for text in listen],
        dials if connect is None else [Endpoint("--connect", text) for text in connect],
    )


def meet_as_observer(
    session: Session, observer: Identity, connect: Sequence[str] | None = None
) -> Meeting:
    """Return how a dashboard or a recorder hears the sites."""
    network = session.network
    if connect:
        dials = [Endpoint("--connect", text) for text in connect]
    elif network.router is not None:
        dials = [Endpoint("network.router", network.router)]
    else:
        dials = [
            Endpoint(f"network.{key}", getattr(network, key))
            for key in ("local_listen", "remote_listen")
        ]
    return _meet(session, observer, [], dials)


def meet_as_router(session: Session, listen: Sequence[str] | None = None) -> Meeting:
    """Return how the relay of a session waits for its sites and observers."""
    if session.network.router is None:
        raise SecurityError(
            "network.router is missing: it tells where the relay is, "
            'such as "quic/relay.example:7447"'
        )
    listens = [Endpoint("network.router", session.network.router)]
    if listen:
        listens = [Endpoint("--listen", text) for text in listen]
    return _meet(session, ROUTER, listens, [])


def most_relayed_hz(session: Session) -> float | None:
    """Return how many packets a second of each site the session's relay lets through at most.

    Packets that come closer together are thinned; None without a relay.
    """
    return None if session.network.router is None else BURST * 1e9 / session.send_period_ns


def keys_folder(session: Session) -> Path:
    """Return the folder of the session's identities: beside the session file unless it says."""
    if session.network.keys is not None:
        return Path(session.network.keys)
    return session.path.resolve().parent / "keys"


def _at_the_local_site(session: Session, operator: str | None) -> Identity:
    """Return whose certificate the local site shows."""
    folder = keys_folder(session)
    if session.network.security != "mtls":
        if operator is not None:
            raise SecurityError(
                f'--as {operator}: without network.security = "mtls" nobody could tell who it is'
            )
        return SITES[SiteId.LOCAL]
    names = sorted(place.name for place in folder.iterdir()) if folder.is_dir() else []
    here = [Identity(name) for name in names if name.partition(".")[0] in PEOPLE]
    if operator is None:
        if len(here) == 1 and SITES[SiteId.LOCAL].name not in names:
            return here[0]
        if here:
            raise SecurityError(
                f"say who you are: --as NAME, of {', '.join(str(one.person) for one in here)}"
            )
        return SITES[SiteId.LOCAL]
    for one in here:
        if one.person == operator:
            return one
    known = ", ".join(str(one.person) for one in here) or "nobody"
    raise SecurityError(
        f"--as {operator}: {folder} has no keys of such an operator, but of {known}; "
        f"`farhand keys SESSION.toml --operator {operator}` makes them"
    )


def _meet(
    session: Session, own: Identity, listens: list[Endpoint], dials: list[Endpoint]
) -> Meeting:
    network = session.network
    credentials = None
    people: tuple[Identity, ...] = ()
    configuration: dict[str, Any] = {}
    if network.security == "mtls":
        credentials = load_credentials(keys_folder(session), own)
        people = _people(credentials)
        _require_certificates(listens, dials)
        configuration |= _mutual_tls(session, credentials, people)
    if own == ROUTER:
        configuration |= _relay(session, people, packets=not network.seals_packets)
    elif network.router is not None:
        # peers of regions of their own, not clients: those cannot start before the router does
        configuration["region_name"] = _region(own).value
    if network.router is not None:
        listens, dials = [*map(_wide_area, listens)], [*map(_wide_area, dials)]
    warnings = _require_secrecy(network.allow_plaintext, [*listens, *dials])
    if credentials is not None and (left := credentials.left()) < NEAR:
        warnings.append(
            f"the certificate {credentials.common_name} expires in {left.days} days: "
            f"`farhand keys renew SESSION.toml {own.name}` makes the next"
        )
    settings = ZenohSettings(
        listen=tuple(one.text for one in listens),
        connect=tuple(one.text for one in dials),
        lease_ms=round(network.lease_s * 1e3),
        open_timeout_ms=round(network.open_timeout_s * 1e3),
        tier=_tier(own, network.router is not None),
        config_file=network.zenoh_config,
        configuration=configuration,
    )
    return Meeting(settings, credentials, tuple(warnings), people, _packets(session, own, people))


def _packets(session: Session, own: Identity, people: Sequence[Identity]) -> ZenohSettings | None:
    """Return how a party meets the others for sealed packets, if there are any.

    By a node of its own: who comes by UDP shows no certificate, and shall share nothing with what
    certificates protect, not even a routing table.
    """
    network = session.network
    if not network.seals_packets or own.role is Role.OBSERVER:
        return None
    routed = network.router is not None
    remote = SITES[SiteId.REMOTE]
    listens = own == (ROUTER if routed else remote)
    key = "packets_listen" if listens else "packets_connect"
    place = getattr(network, key)
    if place is None:
        raise SecurityError(
            f"network.{key} is missing: of sealed packets {own.name} "
            f'{"listens there" if listens else "dials there"}, such as "udp/192.168.1.2:7449"'
        )
    if not listens and Endpoint(f"network.{key}", place).unspecified:
        raise SecurityError(f'network.{key} = "{place}" is no address that could be dialled')
    locals_ = [state_key(session.name, SiteId.LOCAL, one.person) for one in people]
    locals_ = locals_ or [state_key(session.name, SiteId.LOCAL)]
    remotes = [state_key(session.name, SiteId.REMOTE)]
    configuration: dict[str, Any] = {}
    if own == ROUTER:
        granted = Grant((*locals_, *remotes), (*locals_, *remotes))
        configuration |= _relay(session, people, packets=True, others=False)
    elif own == remote:
        granted = Grant(tuple(locals_), tuple(remotes))
    else:
        granted = Grant(tuple(remotes), (state_key(session.name, SiteId.LOCAL, own.person),))
    if routed and own != ROUTER:
        configuration["region_name"] = _region(own).value
    return ZenohSettings(
        listen=(place,) if listens else (),
        connect=() if listens else (place,),
        lease_ms=round(network.lease_s * 1e3),
        open_timeout_ms=round(network.open_timeout_s * 1e3),
        tier=1 if listens else 0,
        configuration=configuration | {"access_control": packets_control(granted)},
    )


def _people(credentials: Credentials) -> tuple[Identity, ...]:
    """Return who is allowed to be at the local site, each under a name of his own."""
    allowed = sorted(credentials.names_allowed(), key=lambda one: one.name)
    people = tuple(one for one in allowed if one.role in PEOPLE)
    if people and credentials.identity == SITES[SiteId.LOCAL]:
        raise SecurityError(
            "this session has operators, each with keys of his own: the keys of the local site "
            "alone are not obeyed any more"
        )
    return people


def _region(own: Identity) -> Role:
    return Role.LOCAL if own.role in PEOPLE else own.role


def _tier(own: Identity, routed: bool) -> int:
    """Return how many there are in a row who dial each other before this one."""
    if routed:
        return 1 if own == ROUTER else 0
    # observers dial both sites, the local site the remote one
    return {Role.LOCAL: 1, Role.REMOTE: 2}.get(_region(own), 0)


def _require_certificates(listens: Sequence[Endpoint], dials: Sequence[Endpoint]) -> None:
    """Refuse, of a session with certificates, endpoints that cannot show or check one."""
    for one in (*listens, *dials):
        if not one.encrypted:
            raise SecurityError(
                f'{one.named_by} = "{one.text}": with security = "mtls" every endpoint is tls/ or '
                "quic/; whoever came by another would show no certificate and be denied everything"
            )
    for one in dials:
        if one.unspecified:
            raise SecurityError(
                f'{one.named_by} = "{one.text}" is no address that a certificate could name: '
                "give the site's own with --connect"
            )


def _require_secrecy(allow_plaintext: bool, endpoints: Sequence[Endpoint]) -> list[str]:
    """Refuse, or where allowed return warnings for, plain text that leaves the machine."""
    warnings = []
    for one in in_the_clear(endpoints):
        if not allow_plaintext:
            raise SecurityError(
                f'{one.named_by} = "{one.text}" is plain text beyond this machine: anybody on the '
                'way can read it and move the robot. Use network.security = "mtls" with tls/ or '
                "quic/ endpoints (docs/deployment.md), or, on a network of your own, "
                "network.allow_plaintext = true"
            )
        warnings.append(
            f'{one.named_by} = "{one.text}" is plain text (network.allow_plaintext): anybody on '
            "the way can read it and move the robot"
        )
    return warnings


def _mutual_tls(
    session: Session, credentials: Credentials, people: Sequence[Identity]
) -> dict[str, Any]:
    key, certificate = credentials.file(KEY_FILE), credentials.file(CERTIFICATE_FILE)
    routed = session.network.router is not None
    sealed = session.network.seals_packets
    granted = grants(session.name, credentials.identity, routed, people, sealed)
    return {
        "transport/link/tls": {
            "root_ca_certificate": credentials.file(AUTHORITY_FILE),
            "listen_private_key": key,
            "listen_certificate": certificate,
            "connect_private_key": key,
            "connect_certificate": certificate,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            # else a transport outlives the certificate that opened it
            "close_link_on_expiration": True,
        },
        "access_control": access_control(granted, credentials.names_allowed()),
    }


def _relay(
    session: Session, people: Sequence[Identity], *, packets: bool, others: bool = True
) -> Mapping[str, Any]:
    """Return what makes a node a relay, of packets or all else, with limits on size and rate."""
    persons = [one.person for one in people if one.person is not None]
    parties: list[tuple[SiteId, str | None]] = [(SiteId.LOCAL, one) for one in persons]
    parties = [*(parties or [(SiteId.LOCAL, None)]), (SiteId.REMOTE, None)]
    states = [state_key(session.name, *party) for party in parties]
    sizes: list[tuple[str, list[str], int]] = []
    if packets:
        sizes.append(("state", states, MOST_STATE_BYTES))
    else:
        offers = [offer_key(session.name, *party) for party in parties]
        sizes.append(("offer", offers, MOST_OFFER_BYTES))
    if others:
        rows = [telemetry_key(session.name, *party) for party in parties]
        sizes.append(("telemetry", rows, MOST_TELEMETRY_BYTES))
        sizes.append(("lease", [lease_key(session.name)], MOST_LEASE_BYTES))
        if claims := [claim_key(session.name, one) for one in persons]:
            sizes.append(("claim", claims, MOST_STATE_BYTES))
    regions = (Role.LOCAL, Role.REMOTE, Role.OBSERVER)
    relay: dict[str, Any] = {
        "mode": "router",
        "gateway": {"south": [{"filters": [{"region_names": [role.value]}]} for role in regions]},
        "low_pass_filter": [
            {
                "id": f"{name}-size",
                "flows": ["ingress"],
                "messages": ["put"],
                "key_exprs": keys,
                "size_limit": size,
            }
            for name, keys, size in sizes
        ],
    }
    if packets:
        # not of telemetry, whose batches come in bursts and must all arrive
        relay["downsampling"] = [
            {
                "id": "state-rate",
                "flows": ["ingress"],
                "messages": ["put"],
                "rules": [{"key_expr": key, "freq": most_relayed_hz(session)} for key in states],
            }
        ]
    return relay


def _wide_area(endpoint: Endpoint) -> Endpoint:
    """Let QUIC carry packets as datagrams, declarations on a stream."""
    if endpoint.protocol == "quic" and "?" not in endpoint.text:
        return Endpoint(endpoint.named_by, f"{endpoint.text}?mixed_rel=1")
    return endpoint
