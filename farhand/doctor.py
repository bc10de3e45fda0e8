"""`farhand doctor`."""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.markup import escape
from rich.table import Table

from channel.link import LinkError
from channel.zenoh_link import ZenohNode, ZenohSettings
from farhand.console import ERR, OUT, say, user_errors
from farhand.demo import SESSION
from hardware.simulated import SimulatedSettings
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime import doctor_machine as machine
from site_runtime.assembly import Surroundings
from site_runtime.clock import SteadyClock
from site_runtime.daemon import StopSignals
from site_runtime.doctor_disk import disk_writes, free_disk
from site_runtime.doctor_findings import Finding, Verdict, holds_the_rate
from site_runtime.doctor_network import (
    answer,
    doctor_keys,
    measure_round_trips,
    round_trip_finding,
)
from site_runtime.doctor_timing import (
    NotDrivenError,
    as_granted,
    lateness_finding,
    measure_lateness,
    measure_ticks,
    tick_finding,
)
from site_runtime.flight_recorder import recorder_folder
from site_runtime.keys import SiteId, state_key, telemetry_key
from site_runtime.margin import margin_of
from site_runtime.parts import robot_of
from site_runtime.real_time import RealTimeSettings, apply_real_time
from site_runtime.session import LocalSettings, RemoteSettings, Session, load_session
from telemetry.dashboard import free_port

EXIT_CANNOT = 1
_BY_KEYS = "a doctor has no keys, and meets nobody at a relay"
_LINK_TEST = "farhand link-test SESSION.toml measures the way, --answer on the other machine"
_COLOURS = {
    Verdict.GOOD: "green",
    Verdict.WILL_DO: "yellow",
    Verdict.NOT_GOOD: "red",
    Verdict.NOT_MEASURED: "cyan",
}


def doctor(
    session: Annotated[
        Path | None,
        typer.Argument(metavar="[SESSION.toml]", help="Without one, the demo's stands in."),
    ] = None,
    site: Annotated[
        Literal["local", "remote"], typer.Option("--site", help="Which site is to run here.")
    ] = "local",
    seconds: Annotated[
        float, typer.Option("--seconds", help="How long each thing is measured.", min=0.1)
    ] = 10.0,
    answering: Annotated[
        bool, typer.Option("--answer", help="Answer a doctor on the other machine until Ctrl-C.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")] = False,
) -> None:
    """Tell whether this machine can hold the rate, and what to change. Exit code 1: it cannot."""
    with user_errors():
        loaded = load_session(SESSION if session is None else session)
        if answering:
            _answer(loaded)
            return
        identity = SiteId[site.upper()]
        asks = session is not None and identity is SiteId.LOCAL  # it is the one that connects
        findings = []
        for finding in _examine(loaded, identity, seconds, asks=asks):
            findings.append(finding)
            if not as_json:
                ERR.print(f"{finding.what}: {finding.verdict.value}", style="dim")
    holds = holds_the_rate(findings)
    if as_json:
        _print_json(loaded, findings, holds)
    else:
        _print(loaded, findings, holds)
    if not holds:
        raise typer.Exit(EXIT_CANNOT)


def _examine(
    session: Session, identity: SiteId, seconds: float, *, asks: bool
) -> Iterator[Finding]:
    settings = session.real_time
    local = identity is SiteId.LOCAL
    cpu = settings.local_cpu if local else settings.remote_cpu
    yield machine.kernel()
    yield machine.privileges(settings)
    yield machine.governor()
    yield machine.cores(cpu, f"{identity.label}_cpu")
    yield machine.clock()
    before = machine.processor_times()
    yield lateness_finding(
        "lateness, ordinary",
        measure_lateness(session.period_ns, seconds, RealTimeSettings("off"), None),
        session.period_ns,
        decisive=settings.mode == "off",
    )
    if settings.mode != "off":
        yield lateness_finding(
            f"lateness, SCHED_FIFO {settings.priority}",
            measure_lateness(session.period_ns, seconds, settings, cpu),
            session.period_ns,
            decisive=True,
        )
    yield _tick(session, identity, seconds, cpu)
    yield machine.load(before)
    folder = recorder_folder(session, identity.label)
    yield disk_writes(folder)
    yield free_disk(folder, session.recorder.keep_s)
    if asks:
        yield _round_trip(session, seconds)


def _tick(session: Session, identity: SiteId, seconds: float, cpu: int | None) -> Finding:
    """Time one site's ticks, with its peer, simulated robots and real Zenoh in this process."""
    what = f"{identity.label} tick"
    session = _simulated(session)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    clock = SteadyClock()
    with (
        closing(ZenohNode(ZenohSettings(listen=(endpoint,)))) as remote_node,
        closing(ZenohNode(ZenohSettings(connect=(endpoint,)))) as local_node,
    ):
        surroundings = (
            Surroundings(
                link=node.link(state_key(session.name, site), state_key(session.name, site.peer)),
                clock=clock,
                session_start_ns=clock.now_ns(),
                epoch=1 + site,
                publish=node.publisher(telemetry_key(session.name, site)),
            )
            for site, node in ((SiteId.LOCAL, local_node), (SiteId.REMOTE, remote_node))
        )
        sites = (
            build_local_site(session, next(surroundings)),
            build_remote_site(session, next(surroundings)),
        )
        with apply_real_time(as_granted(session.real_time), cpu):
            try:
                taken = measure_ticks(sites, clock, session.period_ns, seconds)
            except NotDrivenError as error:
                return Finding(what, Verdict.NOT_MEASURED, str(error), decisive=True)
    return tick_finding(what, taken[identity], session.period_ns)


def _simulated(session: Session) -> Session:
    """Put simulated robots, which no one need hold, in the place of a session's own."""
    local: LocalSettings = replace(session.local, force_sensor=None)
    remote: RemoteSettings = replace(session.remote, force_sensor=None)
    if not isinstance(local.device, SimulatedSettings):
        local = replace(local, device=_bent(session, SiteId.LOCAL))
    if not isinstance(remote.device, SimulatedSettings):
        remote = replace(remote, device=_bent(session, SiteId.REMOTE))
    engagement = replace(session.engagement, alignment="none")
    return replace(session, local=local, remote=remote, engagement=engagement)


def _bent(session: Session, site: SiteId) -> SimulatedSettings:
    return SimulatedSettings((0.5,) * robot_of(session, site).joints)


def _round_trip(session: Session, seconds: float) -> Finding:
    if _meet_by_keys(session):
        return Finding("round trip", Verdict.NOT_MEASURED, _BY_KEYS, _LINK_TEST)
    endpoint = session.network.local_connect
    asks, answers = doctor_keys(session.name)
    settings = ZenohSettings(connect=(endpoint,), config_file=session.network.zenoh_config)
    with closing(ZenohNode(settings)) as node:
        trips = measure_round_trips(node.link(asks, answers), seconds)
    return round_trip_finding(trips, endpoint, margin_of(session).certified_s, session.period_ns)


def _meet_by_keys(session: Session) -> bool:
    """Whether the sites meet where a doctor, who has no keys, is let in by nobody."""
    return session.network.security != "none" or session.network.router is not None


def _answer(session: Session) -> None:
    if _meet_by_keys(session):
        raise LinkError(f"{_BY_KEYS}: {_LINK_TEST}")
    endpoint = session.network.remote_listen
    asks, answers = doctor_keys(session.name)
    settings = ZenohSettings(listen=(endpoint,), config_file=session.network.zenoh_config)
    with (
        StopSignals(SteadyClock(), None) as signals,
        closing(ZenohNode(settings)) as node,
    ):
        say(f"answering at {endpoint} until Ctrl-C")
        answered = answer(node.link(answers, asks), signals.asked_to_stop)
    say(f"{answered} answered")


def _print(session: Session, findings: list[Finding], holds: bool) -> None:
    table = Table(show_header=False, show_lines=True)
    for _ in range(3):
        table.add_column(overflow="fold")
    for found in findings:
        colour = _COLOURS[found.verdict]
        told = escape(found.measured)
        if found.change:
            told += f"\n[bold]{escape(found.change)}[/bold]"
        table.add_row(found.what, f"[{colour}]{found.verdict.value}[/{colour}]", told)
    OUT.print(table)
    rate = f"{session.loop.rate_hz} Hz"
    if holds:
        say(f"this machine holds {rate}")
    elif any(found.decisive and found.verdict is Verdict.NOT_GOOD for found in findings):
        say(f"[red]this machine does not hold {rate}[/red]")
    else:
        say(f"[red]whether this machine holds {rate} could not be measured[/red]")


def _print_json(session: Session, findings: list[Finding], holds: bool) -> None:
    document = {
        "session": session.name,
        "rate_hz": session.loop.rate_hz,
        "holds_the_rate": holds,
        "findings": [asdict(found) | {"verdict": found.verdict.value} for found in findings],
    }
    typer.echo(json.dumps(document, ensure_ascii=False, indent=2))
