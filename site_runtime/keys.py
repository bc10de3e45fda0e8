"""Site numbers and the Zenoh key expressions of a session."""

from enum import IntEnum


class SiteId(IntEnum):
    """A site's number in packets and telemetry."""

    LOCAL = 0
    REMOTE = 1

    @property
    def peer(self) -> "SiteId":
        """The other site."""
        return SiteId.REMOTE if self is SiteId.LOCAL else SiteId.LOCAL

    @property
    def label(self) -> str:
        """`local` or `remote`."""
        return self.name.lower()


def state_key(session_name: str, site: SiteId, operator: str | None = None) -> str:
    """Key of a site's poses; its liveliness token stands beside it."""
    return f"{_branch(session_name, site, operator)}/state"


def offer_key(session_name: str, site: SiteId, operator: str | None = None) -> str:
    """Key of what a site's run offers its peer for sealing their packets."""
    return f"{_branch(session_name, site, operator)}/offer"


def telemetry_key(session_name: str, site: SiteId, operator: str | None = None) -> str:
    """Key of a site's batches of rows."""
    return f"{_branch(session_name, site, operator)}/telemetry"


def presence_keys(session_name: str, site: SiteId, operator: str | None = None) -> str:
    """Key expression of the liveliness tokens of a site's runs."""
    return f"{state_key(session_name, site, operator)}/present/*"


def claim_key(session_name: str, operator: str) -> str:
    """Key on which an operator says that he wants the remote robot."""
    return f"farhand/{session_name}/claim/{operator}"


def lease_key(session_name: str) -> str:
    """Key on which the remote site tells how it is and who holds it; any session is `*`."""
    return f"farhand/{session_name}/remote/lease"


def _branch(session_name: str, site: SiteId, operator: str | None) -> str:
    own = "" if operator is None else f"/{operator}"
    return f"farhand/{session_name}/{site.label}{own}"
