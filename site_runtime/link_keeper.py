"""Sees to it that a link that is connected and yet dead is opened anew."""

from typing import Final, Protocol

from site_runtime.clock import Clock
from site_runtime.daemon_log import DaemonLog
from site_runtime.keeper import Keeper
from site_runtime.site import Site

UNHEARD_S: Final = 3.0
"""So long must the peer not answer: longer than any round trip of a usable network."""

ASK_S: Final = 2.0
"""So long may whoever is connected take to say whether the peer is there."""

LONGEST_S: Final = 60.0
"""Where opening anew does not help, the time between two tries doubles up to this."""

_LOOK_S = 0.5


class Connection(Protocol):
    """What the keeper needs of the node."""

    def dialled(self) -> bool:
        """Whether all that it dials is connected."""

    def reopen(self) -> None:
        """Leave the network and join it anew, however long it takes."""


class Question(Protocol):
    """What the keeper needs of the link."""

    def ask_for_peer(self, within_s: float) -> bool | None:
        """Ask whoever is connected whether the peer is there; None if that is not answered."""


class LinkKeeper(Keeper):
    """Watches one site's channel from a thread of its own, in a `with` statement.

    Only the site that dials can mend a connection, and only where one stands: an outage is waited
    out. A peer that obeys another site, or one with another session, is heard and so no reason. Nor
    is one that is not there, as behind a router: whoever is connected says so, and by saying it,
    that the connection lives.
    """

    def __init__(
        self, site: Site, connection: Connection, link: Question, clock: Clock, log: DaemonLog
    ) -> None:
        super().__init__("link", _LOOK_S, log)
        self._site = site
        self._connection = connection
        self._link = link
        self._clock = clock
        self._refused = 0
        self._patience_s = UNHEARD_S
        self._well_ns = clock.now_ns()

    def look(self) -> None:
        """Open the link anew if it has been connected for so long, and the peer not answered."""
        now_ns = self._clock.now_ns()
        if self._answered(now_ns):
            self._patience_s = UNHEARD_S
            self._well_ns = now_ns
        elif not self._connection.dialled():
            self._well_ns = now_ns
        elif now_ns - self._well_ns >= self._patience_s * 1e9:
            if self._dead():
                self._patience_s = min(2.0 * self._patience_s, LONGEST_S)
                self._log.say("connected, and no answer: the connection is opened anew", "WARN")
                self._connection.reopen()
            self._well_ns = self._clock.now_ns()

    def look_failed(self) -> None:
        """Leave the link as it is: silence is what stops a site, and it watches that itself."""
        self._well_ns = self._clock.now_ns()

    def _dead(self) -> bool:
        """Whether the connection carries no question, or the peer is there and should answer."""
        present = self._link.ask_for_peer(ASK_S)
        # without the lease, the peer does not listen here, or this site not to it
        return present is None or (present and not self._site.requests.unleased)

    def _answered(self, now_ns: int) -> bool:
        channel = self._site.channel
        refused, before = channel.counters.rejected_total, self._refused
        self._refused = refused
        if refused != before or (channel.peer_taken and _recent(channel.heard_ns, now_ns)):
            return True
        return _recent(channel.echoed_ns, now_ns)


def _recent(stamp_ns: int | None, now_ns: int) -> bool:
    return stamp_ns is not None and now_ns - stamp_ns < UNHEARD_S * 1e9
