"""Zenoh's access control, generated from a session: who may say what, and who may hear it.

Everything is denied but what stands here, in both directions, by the common name in the certificate
at the other end of each connection. Sites, router and observers each enforce it for themselves.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from site_runtime.keys import SiteId, presence_keys, state_key, telemetry_key
from site_runtime.security.identity import ROUTER, SITES, Identity, Role

_SAY = ("put", "liveliness_token")
_ASK = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")


@dataclass(frozen=True, slots=True)
class Grant:
    """What may come from a party, and what may go to it: key expressions."""

    says: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()


def grants(session_name: str, own: Identity, routed: bool) -> Mapping[Role, Grant]:
    """Return what the party `own` grants to others; who is not named gets nothing.

    With `routed` all meet at the router, and each of them knows nobody else.
    """
    if own == ROUTER:
        return {
            **{Role(site.label): _site(session_name, site) for site in SiteId},
            Role.OBSERVER: Grant(hears=_telemetry(session_name)),
        }
    if own.role is Role.OBSERVER:
        if routed:
            return {Role.ROUTER: Grant(says=_telemetry(session_name))}
        return {
            Role(site.label): Grant(says=(telemetry_key(session_name, site),)) for site in SiteId
        }
    site = next(site for site in SiteId if SITES[site] == own)
    peer, observer = _poses(session_name, site.peer), telemetry_key(session_name, site)
    hears = _poses(session_name, site)
    if routed:
        return {Role.ROUTER: Grant(says=peer, hears=(*hears, observer))}
    return {
        Role(site.peer.label): Grant(says=peer, hears=hears),
        Role.OBSERVER: Grant(hears=(observer,)),
    }


def access_control(
    granted: Mapping[Role, Grant], allowed: Mapping[Identity, str]
) -> dict[str, Any]:
    """Return Zenoh's `access_control` for these grants and common names."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for role, grant in granted.items():
        names = sorted(name for identity, name in allowed.items() if identity.role is role)
        if not names:
            continue  # an empty list would be everybody
        own = [{"id": f"{role}-{name}", **rule} for name, rule in _rules(grant)]
        rules += own
        subjects.append({"id": role.value, "cert_common_names": names})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [role.value]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(grant: Grant) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, keys, says, asks in (
        ("says", grant.says, "ingress", "egress"),
        ("hears", grant.hears, "egress", "ingress"),
    ):
        if keys:
            yield name, _rule(says, _SAY, keys)
            yield f"{name}-asked", _rule(asks, _ASK, keys)


def _rule(flow: str, messages: tuple[str, ...], keys: tuple[str, ...]) -> dict[str, Any]:
    return {
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _site(session_name: str, site: SiteId) -> Grant:
    return Grant(
        says=(*_poses(session_name, site), telemetry_key(session_name, site)),
        hears=_poses(session_name, site.peer),
    )


def _poses(session_name: str, site: SiteId) -> tuple[str, ...]:
    return state_key(session_name, site), presence_keys(session_name, site)


def _telemetry(session_name: str) -> tuple[str, ...]:
    return tuple(telemetry_key(session_name, site) for site in SiteId)
