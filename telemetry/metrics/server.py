"""A site's Prometheus endpoint, in a process of its own: `python -m telemetry.metrics.server`.

It reads one site's rows from shared memory, as the recorder does. The first line of its standard
input tells what to do; it answers with one line and ends with the site.
"""

import json
import mmap
import sys
from typing import Final

from prometheus_client import CollectorRegistry, start_http_server

from telemetry.companion import input_ended, stand_back
from telemetry.metrics.site_metrics import MetricsOptions, SiteMetrics
from telemetry.row_ring import RowRing

UPDATE_S: Final = 0.5  # a small part of the time that the ring holds


def main() -> None:
    """Serve the ring in the memory whose file descriptor is the first argument."""
    stand_back()
    try:
        ring = RowRing.attach(mmap.mmap(int(sys.argv[1]), 0))
        options = MetricsOptions.from_json(sys.stdin.readline())
        metrics = SiteMetrics(ring, options)
        registry = CollectorRegistry()
        registry.register(metrics)
        server, _ = start_http_server(options.port, options.host, registry)
    except Exception as error:
        cause = str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        _answer(error=cause)
        sys.exit(1)
    _answer(port=server.server_port)
    while not input_ended(sys.stdin.fileno(), UPDATE_S):
        metrics.update()


def _answer(**values: object) -> None:
    print(json.dumps(values), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
