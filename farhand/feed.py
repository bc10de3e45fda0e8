"""A session's telemetry as it comes off the network, checked."""

import time
from collections.abc import Sequence

from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.session import Session
from telemetry.rows import TelemetryError
from telemetry.stream import Batch, decode_batch

_CAPACITY = 4000  # batches: well over half a minute of both sites


class Feed:
    """Batches of both sites; those of another session, and broken ones, are counted and dropped.

    Peers do not forward for each other, so it connects to both sites: by default where the session
    file says that they listen.
    """

    def __init__(self, session: Session, connect: Sequence[str] | None = None) -> None:
        network = session.network
        self._digest = session.digest
        self._node = ZenohNode(
            ZenohSettings(
                connect=tuple(connect or (network.local_listen, network.remote_listen)),
                lease_ms=round(network.lease_s * 1e3),
                open_timeout_ms=round(network.open_timeout_s * 1e3),
                config_file=network.zenoh_config,
            )
        )
        self._subscriptions = [
            self._node.subscriber(telemetry_key(session.name, site), _CAPACITY) for site in SiteId
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
