"""A session's telemetry as it comes off the network, checked."""

import time
from collections.abc import Sequence

from channel.zenoh_link import ZenohNode
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.security.identity import Identity
from site_runtime.security.network import Meeting, meet_as_observer
from site_runtime.session import Session
from telemetry.rows import TelemetryError
from telemetry.stream import Batch, decode_batch

DASHBOARD = "dashboard"
_CAPACITY = 4000  # batches: well over half a minute of both sites


def telemetry_keys(session: Session, meeting: Meeting) -> list[str]:
    """Return where a session's rows are told: those of every operator, and of the remote site."""
    operators = [one.person for one in meeting.people]
    local = [telemetry_key(session.name, SiteId.LOCAL, one) for one in operators or [None]]
    return [*local, telemetry_key(session.name, SiteId.REMOTE)]


class Feed:
    """Batches of both sites; those of another session, and broken ones, are counted and dropped.

    Peers do not forward for each other, so it connects to both sites: by default where the session
    file says that they listen, or to its router. `observer` names whose certificate it shows, if
    the session wants one. `warnings` are for people.
    """

    def __init__(
        self,
        session: Session,
        connect: Sequence[str] | None = None,
        observer: str = DASHBOARD,
    ) -> None:
        self._digest = session.digest
        meeting = meet_as_observer(session, Identity(observer), connect)
        self.warnings = meeting.warnings
        self._node = ZenohNode(meeting.settings)
        self._subscriptions = [
            self._node.subscriber(key, _CAPACITY) for key in telemetry_keys(session, meeting)
        ]
        self.foreign = 0
        self.broken = 0

    def receive(self) -> list[tuple[Batch, int]]:
        """Return (batch, arrival [ns, monotonic]) of all that came since the last call."""
        arrival_ns = time.monotonic_ns()
        batches = []
        for subscription in self._subscriptions:
            for _, payload in subscription.receive():
                try:
                    batch = decode_batch(payload)
                except TelemetryError:
                    self.broken += 1
                    continue
                if batch.digest != self._digest:
                    self.foreign += 1
                    continue
                batches.append((batch, arrival_ns))
        return batches

    def close(self) -> None:
        """Leave the network."""
        self._node.close()
