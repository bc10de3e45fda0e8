"""The Prometheus endpoint of a daemon: where it listens, and what it is told."""

from dataclasses import dataclass

import typer

from site_runtime.guard import Cut, cut_names
from site_runtime.session import Session
from site_runtime.site import Site
from site_runtime.supervisor import State
from telemetry.companion import SharedMemory
from telemetry.metrics import MetricsOptions
from telemetry.metrics_process import MetricsProcess

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class MetricsAddress:
    """Where to serve metrics; port 0 is any that is free."""

    host: str
    port: int


def metrics_address(text: str) -> MetricsAddress:
    """Read PORT or HOST:PORT; typer.BadParameter for anything else."""
    host, colon, port = text.rpartition(":")
    if not port.isascii() or not port.isdigit() or int(port) > 65535 or (colon and not host):
        raise typer.BadParameter(f"{text!r} is no port from 0 to 65535, nor HOST:PORT")
    return MetricsAddress(host.strip("[]") or LOOPBACK, int(port))


def start_metrics(
    session: Session, site: Site, memory: SharedMemory, address: MetricsAddress, *, recorded: bool
) -> MetricsProcess:
    """Serve the metrics of a site that keeps its rows in `memory`; TelemetryError if it cannot."""
    return MetricsProcess(
        memory,
        MetricsOptions(
            host=address.host,
            port=address.port,
            session_name=session.name,
            site=site.identity.label,
            states={state.value: state.name for state in State},
            limits={cut.value: cut_names(cut) for cut in Cut if cut},
            recorded=recorded,
        ),
    )
