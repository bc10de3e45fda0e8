"""`farhand router`: the relay where the sites of a session and its observers meet."""

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from typing import Annotated

import typer

from channel.zenoh_link import Subscription, ZenohNode, stock_configuration
from farhand.console import ERR, user_errors
from site_runtime.clock import SteadyClock
from site_runtime.daemon import (
    Duration,
    Listen,
    Metrics,
    SessionPath,
    StopSignals,
    packets_node,
)
from site_runtime.keys import SiteId, state_key
from site_runtime.metrics import MetricsAddress
from site_runtime.security.network import meet_as_router
from site_runtime.service_manager import ServiceManager
from site_runtime.session import SessionError, load_session
from telemetry.metrics.relay_metrics import RelayMetrics, served

POLL_S = 0.2
STATUS_S = 10.0
_CAPACITY = 20_000


def router(
    session: SessionPath,
    listen: Listen = None,
    duration: Duration = None,
    metrics: Metrics = None,
    print_config: Annotated[
        bool,
        typer.Option("--print-config", help="Print the configuration for a zenohd, and end."),
    ] = False,
    print_packets_config: Annotated[
        bool,
        typer.Option(
            "--print-packets-config", help="Print that of a zenohd for sealed packets, and end."
        ),
    ] = False,
) -> None:
    """Relay a session between its sites and observers until Ctrl-C: where network.router says."""
    with user_errors():
        loaded = load_session(session)
        meeting = meet_as_router(loaded, listen)
        if print_config:
            typer.echo(stock_configuration(meeting.settings))
            return
        if print_packets_config:
            if meeting.packets is None:
                raise SessionError("network.packets_listen is missing: no packets are sealed")
            typer.echo(stock_configuration(meeting.packets))
            return
        for warning in meeting.warnings:
            _say(warning, "yellow")
        listens = [*meeting.settings.listen]
        if meeting.packets is not None:
            listens += meeting.packets.listen
        kept = RelayMetrics(loaded.name)
        with (
            closing(ZenohNode(meeting.settings)) as node,
            packets_node(meeting) as packets,
            closing(ServiceManager()) as manager,
            StopSignals(SteadyClock(), duration) as signals,
            _served(kept, metrics) as url,
        ):
            _say(
                f"farhand router · session {loaded.name} · {', '.join(listens)} · "
                + (meeting.credentials.common_name if meeting.credentials else "no certificates")
            )
            if url is not None:
                _say(f"metrics at {url}")
            # not the telemetry, which else would be sent here when nobody looks
            operators = [one.person for one in meeting.people] or [None]
            parties = [*((SiteId.LOCAL, one) for one in operators), (SiteId.REMOTE, None)]
            heard = [
                _Rate(
                    person or site.label,
                    (packets or node).subscriber(state_key(loaded.name, site, person), _CAPACITY),
                )
                for site, person in parties
            ]
            manager.ready()
            _watch(node, heard, signals, manager, kept)
            manager.stopping()


def _served(
    kept: RelayMetrics, address: MetricsAddress | None
) -> AbstractContextManager[str | None]:
    return nullcontext() if address is None else served(kept, address.host, address.port)


class _Rate:
    """How many packets a site has sent through, in all and since the last status line."""

    def __init__(self, name: str, subscription: Subscription) -> None:
        self.name = name
        self.count = 0
        self._subscription = subscription
        self._told = 0

    def poll(self) -> None:
        self.count += len(self._subscription.receive())

    def text(self, over_s: float) -> str:
        """Return the rate, and count anew."""
        rate_hz, self._told = (self.count - self._told) / over_s, self.count
        return f"{self.name} {rate_hz:.0f} packets/s"


def _watch(
    node: ZenohNode,
    heard: Sequence[_Rate],
    signals: StopSignals,
    manager: ServiceManager,
    kept: RelayMetrics,
) -> None:
    """Say who comes and goes, and now and then how much passes."""
    present: tuple[str, ...] = ()
    since_s = time.monotonic()
    while not signals.asked_to_stop():
        for rate in heard:
            rate.poll()
        now = node.partners()
        manager.alive()
        for name in sorted({*now} - {*present}):
            _say(f"{name} connected")
        for name in sorted({*present} - {*now}):
            _say(f"{name} gone")
        present = now
        kept.packets = {rate.name: rate.count for rate in heard}
        kept.connections = len(present)
        kept.connected = tuple(name for name in present if "/" not in name)  # others: addresses
        if (over_s := time.monotonic() - since_s) >= STATUS_S:
            since_s += over_s
            rates = ", ".join(rate.text(over_s) for rate in heard)
            _say(f"{rates} · connected: {', '.join(present) or 'nobody'}")
        time.sleep(POLL_S)


def _say(line: str, style: str | None = None) -> None:
    ERR.print(line, style=style, highlight=False, markup=False, soft_wrap=True)
