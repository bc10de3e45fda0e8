"""The Prometheus endpoint of a daemon: where it listens, and what it is told."""

import re
from dataclasses import dataclass

import typer

from site_runtime.guard import Cut, cut_names
from site_runtime.session import Session
from site_runtime.site import Site
from site_runtime.supervisor import State
from telemetry.companion import SharedMemory
from telemetry.metrics.process import MetricsProcess
from telemetry.metrics.site_metrics import MetricsOptions

LOOPBACK = "127.0.0.1"
_ADDRESS = re.compile(r"(?:(?:\[(?P<v6>[^][]+)\]|(?P<host>[^][:]+)):)?(?P<port>[0-9]{1,5})")


@dataclass(frozen=True, slots=True)
class MetricsAddress:
    """Where to serve metrics; port 0 is any that is free."""

    host: str
    port: int


def metrics_address(text: str) -> MetricsAddress:
    """Read PORT or HOST:PORT, an IPv6 host in brackets; typer.BadParameter for anything else."""
    found = _ADDRESS.fullmatch(text)
    if found is None or int(found["port"]) > 65535:
        raise typer.BadParameter(f"{text!r} is no port from 0 to 65535, nor HOST:PORT")
    return MetricsAddress(found["v6"] or found["host"] or LOOPBACK, int(found["port"]))


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
