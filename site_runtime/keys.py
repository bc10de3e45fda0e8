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


def state_key(session_name: str, site: SiteId) -> str:
    """Key of a site's poses; its liveliness token stands beside it."""
    return f"farhand/{session_name}/{site.label}/state"


def telemetry_key(session_name: str, site: SiteId) -> str:
    """Key of a site's batches of rows."""
    return f"farhand/{session_name}/{site.label}/telemetry"


def presence_keys(session_name: str, site: SiteId) -> str:
    """Key expression of the liveliness tokens of a site's runs."""
    return f"{state_key(session_name, site)}/present/*"
