"""One site as a process: session file in, Zenoh, real-time settings, the loop, a clean end."""

import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Annotated, TypeAlias

import typer
from rich.console import Console

from channel.link import LinkError
from channel.sealed_link import SealedLink
from channel.zenoh_link import ZenohLink, ZenohNode
from hardware.interface import HardwareError
from site_runtime.assembly import Surroundings
from site_runtime.clock import SteadyClock
from site_runtime.daemon_log import DaemonLog, LogFormat
from site_runtime.flight_recorder import start_recorder
from site_runtime.keys import SiteId, claim_key, lease_key, state_key, telemetry_key
from site_runtime.lease_claimant import LeaseClaimant
from site_runtime.lease_keeper import LeaseKeeper, Switch, rules_of
from site_runtime.link_keeper import LinkKeeper
from site_runtime.metrics import MetricsAddress, metrics_address, start_metrics
from site_runtime.operator_requests import OperatorRequests
from site_runtime.other_session import OtherSession
from site_runtime.real_time import RealTimeError, apply_real_time
from site_runtime.seal_keeper import SealedLinkKeeper, SealKeeper
from site_runtime.security.network import Meeting, meet_as_site
from site_runtime.service_manager import ServiceKeeper, ServiceManager
from site_runtime.session import Session, SessionError, load_session
from site_runtime.site import Site
from site_runtime.site_events import Companion, SiteEvents
from site_runtime.status import StatusLine, summary
from site_runtime.terminal_keys import HELP, TerminalKeys
from telemetry.companion import SharedMemory
from telemetry.rows import TelemetryError

SessionPath: TypeAlias = Annotated[
    Path, typer.Argument(metavar="SESSION.toml", help="The session file; the same at both sites.")
]
Connect: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--connect", help="Zenoh endpoint to reach, e.g. tcp/B.example:7447; repeatable."),
]
Listen: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        help="Zenoh endpoint to listen on; loopback unless given, e.g. tcp/0.0.0.0:7447.",
    ),
]
Operator: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--as",
        metavar="NAME",
        help="The operator at the local site, of `farhand keys`; the only one if left out.",
    ),
]
Duration: TypeAlias = Annotated[
    float | None, typer.Option("--duration", help="Stop after so many seconds.", min=0.001)
]
Quiet: TypeAlias = Annotated[
    bool,
    typer.Option("--quiet", help="No live status line, no events; the summary still comes."),
]
NoRecord: TypeAlias = Annotated[
    bool, typer.Option("--no-record", help="No flight recorder: nothing is written to the disk.")
]
Metrics: TypeAlias = Annotated[
    MetricsAddress | None,
    typer.Option(
        "--metrics",
        metavar="[HOST:]PORT",
        parser=metrics_address,
        help="Serve Prometheus metrics there; on loopback unless a host is given, port 0 is any.",
    ),
]
Log: TypeAlias = Annotated[
    LogFormat,
    typer.Option("--log", help="json: one JSON object a line on stderr, and nothing else."),
]

# Ctrl-C, a service manager, a terminal or a login that is lost
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
EMERGENCY_STOP_SIGNAL = signal.SIGUSR1
RESET_SIGNAL = signal.SIGUSR2

_WORDS = 64  # of the lease that wait to be taken in

EXIT_FAULT = 1
EXIT_NOT_STARTED = 2


@dataclass(frozen=True, slots=True)
class DaemonOptions:
    """What the command line may say over the session file; None leaves the file's word."""

    connect: tuple[str, ...] | None
    listen: tuple[str, ...] | None
    duration_s: float | None
    quiet: bool
    record: bool
    metrics: MetricsAddress | None
    log: LogFormat
    operator: str | None = None


def site_command(
    identity: SiteId, build: Callable[[Session, Surroundings], Site]
) -> Callable[..., None]:
    """Return the command that runs one site, for `farhand` and for `python -m`."""

    def command(
        session: SessionPath,
        connect: Connect = None,
        listen: Listen = None,
        duration: Duration = None,
        quiet: Quiet = False,
        no_record: NoRecord = False,
        metrics: Metrics = None,
        log: Log = LogFormat.TEXT,
        operator: Operator = None,
    ) -> None:
        options = DaemonOptions(
            None if connect is None else tuple(connect),
            None if listen is None else tuple(listen),
            duration,
            quiet,
            not no_record,
            metrics,
            log,
            operator,
        )
        raise typer.Exit(run_daemon(identity, build, session, options))

    command.__name__ = identity.label
    command.__doc__ = f"Run the {identity.label} site until Ctrl-C."
    return command


def run_daemon(
    identity: SiteId,
    build: Callable[[Session, Surroundings], Site],
    session_path: Path,
    options: DaemonOptions,
) -> int:
    """Run one site until a signal to stop or the duration's end; return the exit code.

    0 after a clean end, 1 after a fault, 2 if it could not start.
    """
    log = DaemonLog(identity.label, options.log)
    try:
        session = load_session(session_path)
        meeting = meet_as_site(session, identity, options.listen, options.connect, options.operator)
        clock = SteadyClock()
        requests = OperatorRequests()
        shares_rows = options.record or options.metrics is not None
        epoch = time.time_ns()
        with (
            closing(ZenohNode(meeting.settings)) as node,
            packets_node(meeting) as packets,
            closing(SharedMemory()) as memory,
            closing(ServiceManager()) as manager,
        ):
            link: ZenohLink | SealedLink
            switch: ZenohLink | SealKeeper
            if packets is None:
                sealing = None
                link = switch = node.link(
                    state_key(session.name, identity, meeting.person),
                    state_key(session.name, identity.peer, _first_peer(identity, meeting)),
                )
            else:
                sealing = switch = SealKeeper(
                    session, identity, meeting, epoch, node, packets, clock, requests, log
                )
                link = sealing.link
            publish = node.publisher(telemetry_key(session.name, identity, meeting.person))
            if meeting.person is not None:
                publish = _while_leased(requests, publish)
            surroundings = Surroundings(
                link=link,
                clock=clock,
                session_start_ns=clock.now_ns(),
                epoch=epoch,
                publish=publish,
                requests=requests,
                allocate=memory.allocate if shares_rows else bytearray,
            )
            log.about(session.name, epoch)
            site = build(session, surroundings)
            lease = _lease(meeting, session, site, surroundings, node, switch, log)
            other = OtherSession(session, lambda: site.channel.other_session)
            log.say(_greeting(session, site))
            for warning in meeting.warnings:
                log.say(f"network: {warning}", "WARN")
            cpus = session.real_time
            cpu = cpus.local_cpu if identity is SiteId.LOCAL else cpus.remote_cpu
            with (
                StopSignals(clock, options.duration_s, requests) as signals,
                TerminalKeys(requests) as keys,
                # before the recorder, to which a start that fails now were a site that died
                nullcontext()
                if options.metrics is None
                else start_metrics(
                    session, site, memory, options.metrics, recorded=options.record
                ) as metrics,
                start_recorder(session, site, memory)
                if options.record
                else nullcontext() as recorder,
                _status(site, (recorder, metrics, other), _shown(lease), log, options),
                lease,
                nullcontext() if sealing is None else sealing,
                LinkKeeper(site, node, switch, clock, log)
                if sealing is None
                else SealedLinkKeeper(site, sealing, clock, log),
                _service_keeper(manager, site, log),
                apply_real_time(session.real_time, cpu) as real_time,
            ):
                if recorder is not None:
                    log.say(f"recording in {recorder.folder}")
                if metrics is not None:
                    log.say(f"metrics at {metrics.url}")
                for refusal in real_time.refused:
                    log.say(f"real time: {refusal}", "WARN")
                if keys.listening and not options.quiet:
                    log.say(HELP)
                site.run(signals.asked_to_stop)
                site.telemetry.farewell(clock.now_ns())
            if log.format is LogFormat.TEXT:
                summary(site, Console(), recorder, other.trouble or other.told)
            elif recorder is not None and recorder.trouble is not None:
                log.say(recorder.trouble, "WARN")
    except (SessionError, LinkError, HardwareError, RealTimeError, TelemetryError) as error:
        log.say(f"{identity.label} site: {error}", "ERROR")
        return EXIT_NOT_STARTED
    return EXIT_FAULT if site.failure is not None else 0


def packets_node(meeting: Meeting) -> AbstractContextManager[ZenohNode | None]:
    """Open the node for sealed packets, if the session has them."""
    return nullcontext() if meeting.packets is None else closing(ZenohNode(meeting.packets))


def _first_peer(identity: SiteId, meeting: Meeting) -> str | None:
    """Return the operator whom the link knows at first; none is heard before he has the lease."""
    remote_led = identity is SiteId.REMOTE and meeting.people
    return meeting.people[0].person if remote_led else None


def _lease(
    meeting: Meeting,
    session: Session,
    site: Site,
    surroundings: Surroundings,
    node: ZenohNode,
    switch: Switch,
    log: DaemonLog,
) -> LeaseKeeper | LeaseClaimant | AbstractContextManager[None]:
    """Return this site's side of the lease; a local site without operators has none."""
    name, epoch = session.name, surroundings.epoch
    if site.identity is SiteId.REMOTE:
        persons = [one.person for one in meeting.people if one.person is not None]
        return LeaseKeeper(
            session,
            site,
            epoch,
            surroundings.clock,
            switch,
            {person: node.subscriber(claim_key(name, person), _WORDS) for person in persons},
            rules_of(session, meeting.people),
            node.publisher(lease_key(name)),
            log,
        )
    if meeting.person is None:
        return nullcontext()
    return LeaseClaimant(
        meeting.person,
        epoch,
        site,
        node.subscriber(lease_key(name), _WORDS),
        node.publisher(claim_key(name, meeting.person)),
        log,
    )


def _service_keeper(
    manager: ServiceManager, site: Site, log: DaemonLog
) -> ServiceKeeper | AbstractContextManager[None]:
    return ServiceKeeper(manager, lambda: site.ticks, log) if manager.listens else nullcontext()


def _while_leased(
    requests: OperatorRequests, publish: Callable[[bytes], None]
) -> Callable[[bytes], None]:
    """Let observers see one local site at a time: the one that holds the lease."""

    def tell(data: bytes) -> None:
        if not requests.unleased:
            publish(data)

    return tell


def _shown(lease: object) -> tuple[Companion, ...]:
    return (lease,) if isinstance(lease, LeaseClaimant) else ()


def _status(
    site: Site,
    companions: tuple[Companion | None, ...],
    shown: tuple[Companion, ...],
    log: DaemonLog,
    options: DaemonOptions,
) -> StatusLine:
    """Return what tells people, or programs, how the site is while it runs.

    What is `shown` is in the status line only: it makes events of its own.
    """
    text = log.format is LogFormat.TEXT
    running = tuple(companion for companion in companions if companion is not None)
    told = not (text and options.quiet)
    wall_offset_ns = time.time_ns() - SteadyClock().now_ns()
    events = SiteEvents(site, running, log, wall_offset_ns) if told else None
    return StatusLine(site, (*running, *shown), events, live=text and not options.quiet)


class StopSignals:
    """Signals and the duration end the loop between two ticks, never inside one.

    SIGUSR1 is the emergency stop, SIGUSR2 the reset, where there are `requests` to take them.
    """

    def __init__(
        self,
        clock: SteadyClock,
        duration_s: float | None,
        requests: OperatorRequests | None = None,
    ) -> None:
        self._clock = clock
        self._requests = requests
        self._asked = False
        self._end_ns = None if duration_s is None else clock.now_ns() + round(duration_s * 1e9)
        self._before: dict[int, object] = {}

    def asked_to_stop(self) -> bool:
        """Whether the loop should end."""
        return self._asked or (self._end_ns is not None and self._clock.now_ns() >= self._end_ns)

    def __enter__(self) -> "StopSignals":
        for number in STOP_SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # started under nohup, to outlive its terminal
            self._before[number] = signal.signal(number, self._ask)
        if (requests := self._requests) is not None:
            self._before[EMERGENCY_STOP_SIGNAL] = signal.signal(
                EMERGENCY_STOP_SIGNAL, lambda *_: requests.stop()
            )
            self._before[RESET_SIGNAL] = signal.signal(RESET_SIGNAL, lambda *_: requests.reset())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._asked = True


def _greeting(session: Session, site: Site) -> str:
    return (
        f"farhand {site.identity.label} site · session {session.name} "
        f"({session.digest:016x}) · {session.loop.rate_hz} Hz · certified round trip "
        f"{site.margin.certified_s * 1e3:.0f} ms"
    )
