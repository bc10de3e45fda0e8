"""What can be told of a peer that has another session file: packets carry a digest of it only."""

from collections.abc import Callable
from contextlib import suppress

from site_runtime.network_profiles import PROFILES
from site_runtime.session import Session, SessionError, parse_session
from site_runtime.session_edit import edited


class OtherSession:
    """Tells people, as a companion of a site, that the peer has another session file.

    Profiles are tried, as the one thing that machines may well differ in: this file with another
    `network.profile` may have the peer's digest.
    """

    def __init__(self, session: Session, heard: Callable[[], int | None]) -> None:
        """Ask `heard` for the digest of a peer's other session; None while there is no such."""
        self._heard = heard
        self._profile = session.network.profile
        # now, not when a packet is heard: it takes some ticks' time, and packets come unasked
        self._profiles = profile_digests(session)
        self.told: str | None = None
        """What was the trouble last; None if there was none so far."""

    @property
    def trouble(self) -> str | None:
        """What is wrong; None if no such peer was heard within the last second."""
        digest = self._heard()
        if digest is None:
            return None
        self.told = f"the peer has ANOTHER session file: {self._difference(digest)}"
        return self.told

    def _difference(self, digest: int) -> str:
        names = [f'"{name}"' for name, one in self._profiles.items() if one == digest]
        if names:
            return (
                f"as this one with network.profile = {' or '.join(names)}, here it is "
                f'"{self._profile}"; both sites need the same, or the same values in [channel]'
            )
        return (
            "all must agree but [network], [real_time] and [recorder], "
            "and what network.profile says of [channel] counts"
        )


def profile_digests(session: Session) -> dict[str, int]:
    """Return the digests that this session file would have with each network profile it allows."""
    digests = {}
    for name in PROFILES:
        with suppress(SessionError):  # what a profile says may contradict the file
            text = edited(session.text, {"network.profile": name})
            digests[name] = parse_session(text, session.path).digest
    return digests
