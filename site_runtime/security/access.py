"""Zenoh's access control, generated from a session: who may say what, and who may hear it.

Everything is denied but what stands here, in both directions, by the common name in the certificate
at the other end of each connection. Sites, router and observers each enforce it for themselves.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from site_runtime.keys import (
    SiteId,
    claim_key,
    lease_key,
    offer_key,
    presence_keys,
    state_key,
    telemetry_key,
)
from site_runtime.security.identity import ROUTER, SITES, Identity, Role

_SAY = ("put", "liveliness_token")
_ASK = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")


@dataclass(frozen=True, slots=True)
class Grant:
    """What may come from a party, and what may go to it: key expressions."""

    says: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()


def grants(
    session_name: str,
    own: Identity,
    routed: bool,
    people: Sequence[Identity] = (),
    sealed: bool = False,
) -> Mapping[Role | Identity, Grant]:
    """Return what the party `own` grants to others; who is not named gets nothing.

    With `routed` all meet at the router, and each of them knows nobody else. With `people` they,
    each in his own name, are in the place of the local site. With `sealed` poses go another way,
    by `packets_control`, and only what seals them goes here.
    """
    locals_: dict[Role | Identity, Identity] = {one: one for one in people}
    if not locals_:
        locals_[Role.LOCAL] = SITES[SiteId.LOCAL]
    commands = {party: _commands(session_name, one, sealed) for party, one in locals_.items()}
    rows = {party: _rows(session_name, one) for party, one in locals_.items()}
    remote_rows = _rows(session_name, SITES[SiteId.REMOTE])
    answers = (*_to_peer(session_name, SITES[SiteId.REMOTE], sealed), lease_key(session_name))
    shown = (*remote_rows, lease_key(session_name))
    if own == ROUTER:
        return {
            **{party: Grant((*commands[party], *rows[party]), answers) for party in locals_},
            Role.REMOTE: Grant((*answers, *remote_rows), _all(commands)),
            Role.OBSERVER: Grant(hears=(*_all(rows), *shown)),
        }
    if own.role is Role.OBSERVER:
        if routed:
            return {Role.ROUTER: Grant(says=(*_all(rows), *shown))}
        return {
            **{party: Grant(says=rows[party]) for party in locals_},
            Role.REMOTE: Grant(says=shown),
        }
    if own == SITES[SiteId.REMOTE]:
        if routed:
            return {Role.ROUTER: Grant(_all(commands), (*answers, *remote_rows))}
        return {
            **{party: Grant(commands[party], answers) for party in locals_},
            Role.OBSERVER: Grant(hears=shown),
        }
    mine, told = _commands(session_name, own, sealed), _rows(session_name, own)
    if routed:
        return {Role.ROUTER: Grant(answers, (*mine, *told))}
    return {Role.REMOTE: Grant(answers, mine), Role.OBSERVER: Grant(hears=told)}


def access_control(
    granted: Mapping[Role | Identity, Grant], allowed: Mapping[Identity, str]
) -> dict[str, Any]:
    """Return Zenoh's `access_control` for these grants and common names."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for party, grant in granted.items():
        names = sorted(name for one, name in allowed.items() if party in (one, one.role))
        if not names:
            continue  # an empty list would be everybody
        party_id = party.value if isinstance(party, Role) else party.name
        own = [{"id": f"{party_id}-{name}", **rule} for name, rule in _rules(grant)]
        rules += own
        subjects.append({"id": party_id, "cert_common_names": names})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [party_id]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def packets_control(grant: Grant) -> dict[str, Any]:
    """Return Zenoh's `access_control` for where sealed packets pass, and nothing else does.

    It is for whoever comes by UDP, which shows no certificates: the seal tells whose a packet is.
    """
    said = _rules(grant, say=("put",), ask=("declare_subscriber",))
    rules = [{"id": name, **rule} for name, rule in said]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": "packets", "link_protocols": ["udp"]}],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": ["packets"]}],
    }


def _rules(
    grant: Grant, say: tuple[str, ...] = _SAY, ask: tuple[str, ...] = _ASK
) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, keys, says, asks in (
        ("says", grant.says, "ingress", "egress"),
        ("hears", grant.hears, "egress", "ingress"),
    ):
        if keys:
            yield name, _rule(says, say, keys)
            yield f"{name}-asked", _rule(asks, ask, keys)


def _rule(flow: str, messages: tuple[str, ...], keys: tuple[str, ...]) -> dict[str, Any]:
    return {
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _to_peer(session_name: str, one: Identity, sealed: bool) -> tuple[str, ...]:
    site = _site(one)
    if sealed:
        return offer_key(session_name, site, one.person), presence_keys(
            session_name, site, one.person
        )
    return state_key(session_name, site, one.person), presence_keys(session_name, site, one.person)


def _commands(session_name: str, one: Identity, sealed: bool) -> tuple[str, ...]:
    said = _to_peer(session_name, one, sealed)
    return said if one.person is None else (*said, claim_key(session_name, one.person))


def _rows(session_name: str, one: Identity) -> tuple[str, ...]:
    return (telemetry_key(session_name, _site(one), one.person),)


def _site(one: Identity) -> SiteId:
    return SiteId.REMOTE if one == SITES[SiteId.REMOTE] else SiteId.LOCAL


def _all(keys: Mapping[Role | Identity, tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(key for some in keys.values() for key in some)
