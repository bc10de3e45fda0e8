"""The names in certificates: a role, and a generation that revocation counts up."""

import re
from dataclasses import dataclass
from enum import StrEnum

from site_runtime.keys import SiteId
from site_runtime.session_problems import SessionError

_OBSERVER = "observer."
_NAME = re.compile(r"(?:(operator|supervisor)\.)?([a-z0-9][a-z0-9_-]{0,31})")
_COMMON_NAME = re.compile(r"(.+)-([1-9][0-9]{0,8})")


class SecurityError(SessionError):
    """Keys, certificates or endpoints that must not be used as they are."""


class Role(StrEnum):
    """What a certificate is good for."""

    LOCAL = "local"
    REMOTE = "remote"
    OPERATOR = "operator"
    SUPERVISOR = "supervisor"
    ROUTER = "router"
    OBSERVER = "observer"


@dataclass(frozen=True, slots=True)
class Identity:
    """One party on the network. Its `name` is that of its folder, and unique."""

    name: str

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise SecurityError(
                f"{self.name!r} cannot name an identity: use 1 to 32 lower-case letters, digits, "
                "- and _, a letter or digit first; of a person at the local site, operator. or "
                "supervisor. before it"
            )
        if self.name == AUTHORITY:
            raise SecurityError(f"{self.name!r} is the folder of the certificate authority")

    @property
    def role(self) -> Role:
        """A site, the router, a person at the local site, or else an observer."""
        if self.name in {"local", "remote", "router"}:
            return Role(self.name)
        return Role.OBSERVER if self.person is None else Role(self.name.partition(".")[0])

    @property
    def person(self) -> str | None:
        """The name alone of an operator or a supervisor, None for others."""
        return self.name.partition(".")[2] or None

    def common_name(self, generation: int) -> str:
        """Name in its certificate, which access control goes by: `remote-2`."""
        prefix = _OBSERVER if self.role is Role.OBSERVER else ""
        return f"{prefix}{self.name}-{generation}"


AUTHORITY = "authority"
"""The folder of what signs certificates; no identity's name."""
PEOPLE = (Role.OPERATOR, Role.SUPERVISOR)
"""Who takes the place of the local site, each under a name of his own."""
SITES = {SiteId.LOCAL: Identity("local"), SiteId.REMOTE: Identity("remote")}
ROUTER = Identity("router")


def named(common_name: str) -> tuple[Identity, int]:
    """Return the identity and the generation that a certificate names; SecurityError if none."""
    match = _COMMON_NAME.fullmatch(common_name)
    if match is not None:
        identity = Identity(match[1].removeprefix(_OBSERVER))
        generation = int(match[2])
        if identity.common_name(generation) == common_name:
            return identity, generation
    raise SecurityError(f"{common_name!r} is no name that farhand gives to a certificate")
