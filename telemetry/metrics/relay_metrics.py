"""A relay's Prometheus endpoint, in its own process: it has no loop that a scrape could disturb."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, Metric, start_http_server
from prometheus_client.registry import Collector

from telemetry.metrics.families import MetricFamilies
from telemetry.metrics.process import joined
from telemetry.rows import TelemetryError


class RelayMetrics(Collector):
    """What has passed and who is connected; whoever relays keeps both up to date."""

    def __init__(self, session_name: str) -> None:
        self.packets: Mapping[str, int] = {}
        """Packets of poses so far, by who sent them."""
        self.connections = 0
        self.connected: tuple[str, ...] = ()
        """The names in the certificates of who is connected."""
        self._families = MetricFamilies(session=session_name)

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics as they are now."""
        made = self._families
        yield made.counters(
            "farhand_relay_packets", "Packets of poses that came", "party", self.packets
        )
        yield made.gauge("farhand_relay_connections", "Connections", self.connections)
        yield made.gauges(
            "farhand_relay_connected",
            "1 for each certificate that is connected",
            "certificate",
            dict.fromkeys(self.connected, 1.0),
        )


@contextmanager
def served(metrics: RelayMetrics, host: str, port: int) -> Iterator[str]:
    """Serve them within a `with` statement, at the URL returned; TelemetryError if it cannot."""
    registry = CollectorRegistry()
    registry.register(metrics)
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise TelemetryError(
            f"metrics cannot be served on {joined(host, port)}: {error}; name another port, or "
            "run without --metrics"
        ) from error
    try:
        yield f"http://{joined(host, server.server_port)}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
