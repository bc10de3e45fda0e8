"""`farhand router`: the relay where the sites of a session and its observers meet."""

import time
from collections.abc import Sequence
from contextlib import closing
from typing import Annotated

import typer

from channel.zenoh_link import Subscription, ZenohNode, stock_configuration
from farhand.console import ERR, user_errors
from site_runtime.clock import SteadyClock
from site_runtime.daemon import Duration, Listen, SessionPath, StopSignals, packets_node
from site_runtime.keys import SiteId, state_key
from site_runtime.security.network import meet_as_router
from site_runtime.service_manager import ServiceManager
from site_runtime.session import SessionError, load_session

POLL_S = 0.2
STATUS_S = 10.0
_CAPACITY = 20_000


def router(
    session: SessionPath,
    listen: Listen = None,
    duration: Duration = None,
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
        with (
            closing(ZenohNode(meeting.settings)) as node,
            packets_node(meeting) as packets,
            closing(ServiceManager()) as manager,
            StopSignals(SteadyClock(), duration) as signals,
        ):
            _say(
                f"farhand router · session {loaded.name} · {', '.join(listens)} · "
                + (meeting.credentials.common_name if meeting.credentials else "no certificates")
            )
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
            _watch(node, heard, signals, manager)
            manager.stopping()


class _Rate:
    """How many packets a site has sent through since the last status line."""

    def __init__(self, name: str, subscription: Subscription) -> None:
        self._name = name
        self._subscription = subscription
        self._count = 0

    def poll(self) -> None:
        self._count += len(self._subscription.receive())

    def text(self, over_s: float) -> str:
        """Return the rate, and count anew."""
        rate_hz, self._count = self._count / over_s, 0
        return f"{self._name} {rate_hz:.0f} packets/s"


def _watch(
    node: ZenohNode, heard: Sequence[_Rate], signals: StopSignals, manager: ServiceManager
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
        if (over_s := time.monotonic() - since_s) >= STATUS_S:
            since_s += over_s
            rates = ", ".join(rate.text(over_s) for rate in heard)
            _say(f"{rates} · connected: {', '.join(present) or 'nobody'}")
        time.sleep(POLL_S)


def _say(line: str, style: str | None = None) -> None:
    ERR.print(line, style=style, highlight=False, markup=False, soft_wrap=True)
