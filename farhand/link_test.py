"""`farhand link-test`."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer
from rich.table import Table

from channel.link import Link, LinkError
from channel.zenoh_link import ZenohNode
from farhand.console import ERR, OUT, say, user_errors
from site_runtime.clock import SteadyClock
from site_runtime.daemon import Connect, Listen, SessionPath, StopSignals, packets_node
from site_runtime.daemon_log import DaemonLog
from site_runtime.keys import SiteId, state_key
from site_runtime.link_figures import Figures, Passage, Spread, figures, traces
from site_runtime.link_test import (
    SETTLE_S,
    LinkTestError,
    Phase,
    Probe,
    most_measured_hz,
    rates_of,
)
from site_runtime.margin import margin_of
from site_runtime.network_profiles import PROFILES, fitting
from site_runtime.operator_requests import OperatorRequests
from site_runtime.real_time import apply_real_time
from site_runtime.seal_keeper import SealKeeper
from site_runtime.security.identity import SecurityError
from site_runtime.security.network import BURST, Meeting, meet_as_site
from site_runtime.session import Session, load_session

EXIT_NOT_COVERED = 1
TRACES = ("local_to_remote.csv", "remote_to_local.csv")
_CAPACITY = 1024
_MARGIN = 1.1  # of the certificate over the longest loop that was seen


def link_test(
    session: SessionPath,
    answer: Annotated[
        bool, typer.Option("--answer", help="Answer, at the remote site's machine, until Ctrl-C.")
    ] = False,
    duration: Annotated[
        float, typer.Option("--duration", help="Seconds in all, for all rates.", min=1.0)
    ] = 60.0,
    rate: Annotated[
        list[int] | None,
        typer.Option("--rate", help="Packets a second; repeatable. By default five or so.", min=1),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option("--save", help="Folder for both directions' delays, to inject them again."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
    connect: Connect = None,
    listen: Listen = None,
    operator: Annotated[
        str | None,
        typer.Option(
            "--as",
            metavar="NAME",
            help="The operator at the local site; with --answer, whom to answer.",
        ),
    ] = None,
) -> None:
    """Measure the network between the sites, in their place: stop them first.

    Exit code 1 if the session's certificate does not cover what was measured at its own rate.
    """
    with user_errors():
        loaded = load_session(session)
        rates = tuple(sorted(set(rate), reverse=True)) if rate else rates_of(loaded)
        _require_rates(loaded, rates)
        if save is not None:
            save.mkdir(parents=True, exist_ok=True)
        site = SiteId.REMOTE if answer else SiteId.LOCAL
        meeting = meet_as_site(loaded, site, listen, connect, None if answer else operator)
        for warning in meeting.warnings:
            _tell(f"network: {warning}")
        person = _whom(meeting, operator) if answer else meeting.person
        clock = SteadyClock()
        cpus = loaded.real_time
        with (
            _link(loaded, site, meeting, person, clock) as link,
            StopSignals(clock, None) as signals,
            apply_real_time(cpus, cpus.remote_cpu if answer else cpus.local_cpu),
        ):
            probe = Probe(loaded, site, link, clock)
            if answer:
                _tell(f"answering for the {site.label} site until Ctrl-C")
                probe.answer(signals.asked_to_stop)
                return
            if not rate and (most_hz := most_measured_hz(loaded)) < loaded.loop.rate_hz:
                _tell(f"rates up to {most_hz:g} Hz: the router would thin faster ones")
            phases = _measure(probe, rates, duration, signals)
        if not phases:
            raise typer.Exit(EXIT_NOT_COVERED)
        certified_s = margin_of(loaded).certified_s
        measured = [figures(phase, certified_s) for phase in phases]
        own = _own(loaded, measured)
        if save is not None:
            _save(save, phases[measured.index(own)])
    if as_json:
        OUT.print_json(json.dumps(_document(loaded, measured, own, certified_s)), indent=2)
    else:
        _print(loaded, measured, own, certified_s)
    if own.covered < 1.0:
        raise typer.Exit(EXIT_NOT_COVERED)


def _whom(meeting: Meeting, operator: str | None) -> str | None:
    """Return which operator to answer: each has a key of his own, and only it may be heard."""
    names = [one.person for one in meeting.people]
    if operator is None and len(names) <= 1:
        return names[0] if names else None
    if operator not in names:
        known = ", ".join(map(str, names)) or "nobody"
        raise SecurityError(f"--answer: say whom to answer with --as NAME, of {known}")
    return operator


@contextmanager
def _link(
    session: Session, site: SiteId, meeting: Meeting, person: str | None, clock: SteadyClock
) -> Iterator[Link]:
    """Stand in a site's place: where its packets go, sealed if they are."""
    keys = {
        SiteId.LOCAL: state_key(session.name, SiteId.LOCAL, person),
        SiteId.REMOTE: state_key(session.name, SiteId.REMOTE),
    }
    with ExitStack() as stack:
        try:
            node = stack.enter_context(closing(ZenohNode(meeting.settings)))
            packets = stack.enter_context(packets_node(meeting))
        except LinkError as error:
            raise LinkTestError(
                f"{error}. If a site, or another link test, runs on this machine, stop it first"
            ) from error
        if packets is None:
            yield node.link(keys[site], keys[site.peer], capacity=_CAPACITY)
            return
        sealing = SealKeeper(
            session,
            site,
            meeting,
            time.time_ns(),
            node,
            packets,
            clock,
            OperatorRequests(),
            DaemonLog(site.label),
            _CAPACITY,
        )
        sealing.listen_to(keys[site.peer])
        yield stack.enter_context(sealing).link


def _require_rates(session: Session, rates: Sequence[int]) -> None:
    for rate_hz in rates:
        if session.loop.rate_hz % rate_hz:
            raise LinkTestError(
                f"--rate {rate_hz} is not allowed: it must divide loop.rate_hz = "
                f"{session.loop.rate_hz}, a site sends on every k-th tick"
            )
        if rate_hz > (most_hz := most_measured_hz(session)):
            raise LinkTestError(
                f"--rate {rate_hz} is not allowed: the router lets {2 * most_hz:g} packets a "
                f"second through, {BURST} times the session's own rate, and drops what comes too "
                f"soon after another, as if the network had lost it; up to {most_hz:g} Hz nothing "
                "does. A higher channel.send_rate_hz, in the router's session file too, lets more "
                "be measured"
            )


def _measure(
    probe: Probe, rates: Sequence[int], duration_s: float, signals: StopSignals
) -> list[Phase]:
    phases: list[Phase] = []
    _tell("waiting for the answer")
    if not probe.meet(signals.asked_to_stop):
        return phases
    for rate_hz in rates:
        _tell(f"{rate_hz} Hz for {duration_s / len(rates):.3g} s, after {SETTLE_S:g} s to settle")
        phase = probe.measure(rate_hz, duration_s / len(rates), signals.asked_to_stop)
        if phase is None:
            break
        phases.append(phase)
    return phases


def _own(session: Session, measured: Sequence[Figures]) -> Figures:
    """Return the figures of the rate nearest to the session's own."""
    own_hz = 1e9 / session.send_period_ns
    return min(measured, key=lambda one: abs(one.rate_hz - own_hz))


def _best(measured: Sequence[Figures]) -> Figures:
    """Return those of the rate whose loop is youngest, nearly always."""
    return min(measured, key=lambda one: one.bound.p99_s)


def _profile(measured: Sequence[Figures]) -> str:
    """Judge the network by what most rates met: one that floods it, or one stall, does not tell."""
    return fitting(
        min(one.round_trip.p50_s for one in measured),
        median(one.jitter_s for one in measured),
        median(max(one.to_remote.lost, one.to_local.lost) for one in measured),
    )


def _save(folder: Path, phase: Phase) -> None:
    for name, trace in zip(TRACES, traces(phase), strict=True):
        trace.write(folder / name)


def _document(
    session: Session, measured: Sequence[Figures], own: Figures, certified_s: float
) -> dict[str, Any]:
    best = _best(measured)
    return {
        "session": session.name,
        "digest": f"{session.digest:016x}",
        "rates": [asdict(one) for one in measured],
        "own_rate_hz": own.rate_hz,
        "certified_round_trip_s": certified_s,
        "profile": _profile(measured),
        "best_rate_hz": best.rate_hz,
        "certified_needed_s": _MARGIN * best.bound.most_s,
    }


def _print(session: Session, measured: Sequence[Figures], own: Figures, certified_s: float) -> None:
    table = Table(
        title=f"network of session {session.name} [ms: p50 · p99 · most]", title_justify="left"
    )
    table.add_column("packets a second")
    for one in measured:
        table.add_column(f"{one.rate_hz}", justify="right", style="bold" if one is own else None)
    for name, told in _ROWS:
        table.add_row(name, *map(told, measured))
    OUT.print(table)
    best, name = _best(measured), _profile(measured)
    say(f'profile that fits: [bold]\\[network] profile = "{name}"[/bold]{_protocol(name)}')
    say(
        f"send rate with the youngest loop: [bold]{best.rate_hz} Hz[/bold]; gains certified for "
        f"{_MARGIN * best.bound.most_s * 1e3:.0f} ms would cover it "
        f"(the longest, {best.bound.most_s * 1e3:.0f} ms, and a tenth)"
    )
    colour = "green" if own.covered == 1.0 else "red"
    say(
        f"this session sends at {own.rate_hz} Hz and is certified for {certified_s * 1e3:.0f} ms: "
        f"[{colour}]{100.0 * own.covered:.1f} % of the time enough[/{colour}]"
    )
    if own.silence_s >= session.engagement.hold_after_s:
        say(
            f"[yellow]it would have held[/yellow]: {own.silence_s * 1e3:.0f} ms without a packet, "
            f"engagement.hold_after_s is {session.engagement.hold_after_s:g} s"
        )


def _protocol(name: str) -> str:
    tolerant = PROFILES[name].loss_tolerant
    return ", udp/ or quic/ endpoints, or packets_connect" if tolerant else ""


def _ms(spread: Spread) -> str:
    return " · ".join(f"{value * 1e3:.3g}" for value in (spread.p50_s, spread.p99_s, spread.most_s))


def _lost(passage: Passage) -> str:
    return f"{100.0 * passage.lost:.2f} %, {100.0 * passage.reordered:.2f} %"


_ROWS: Sequence[tuple[str, Callable[[Figures], str]]] = (
    ("round trip", lambda one: _ms(one.round_trip)),
    ("to the remote site", lambda one: _ms(one.to_remote.time)),
    ("to the local site", lambda one: _ms(one.to_local.time)),
    ("  both known to ±", lambda one: f"{one.to_local.uncertainty_s * 1e3:.3g}"),
    ("lost, overtaken there", lambda one: _lost(one.to_remote)),
    ("lost, overtaken back", lambda one: _lost(one.to_local)),
    ("age of the loop", lambda one: _ms(one.loop)),
    ("greatest of late", lambda one: _ms(one.bound)),
    ("longest silence", lambda one: f"{one.silence_s * 1e3:.3g}"),
    ("certificate enough", lambda one: f"{100.0 * one.covered:.1f} %"),
)


def _tell(line: str) -> None:
    ERR.print(line, highlight=False, markup=False, soft_wrap=True)
