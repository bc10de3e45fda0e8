"""`farhand record`: both sites' rows off the network, into files."""

import os
import time
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from farhand.console import ERR, OUT, user_errors
from farhand.dashboard import As
from farhand.feed import DASHBOARD, Feed
from site_runtime.clock import SteadyClock
from site_runtime.daemon import Connect, Duration, SessionPath, StopSignals
from site_runtime.keys import SiteId
from site_runtime.session import Session, load_session, named_files
from site_runtime.supervisor import State
from telemetry.network_recorder import NetworkRecorder, Recorded
from telemetry.recording import Gap
from telemetry.rows import TelemetryError

POLL_S = 0.02
EXIT_NOT_RECORDED = 1
SHOWN = 10
SILENT_S = 3.0


def record(
    session: SessionPath,
    connect: Connect = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder to write into; by default one of its own, here."),
    ] = None,
    duration: Duration = None,
    force: Annotated[
        bool, typer.Option("--force", help="Also into a folder that holds recordings.")
    ] = False,
    observer: As = DASHBOARD,
) -> None:
    """Record both sites off the network, from any machine that reaches them, until Ctrl-C."""
    with user_errors():
        loaded = load_session(session)
        folder = _folder(loaded, out, force)
        states = {state.value: state.name for state in State}
        named = {key: path.read_bytes() for key, path in named_files(loaded).items()}
        with (
            closing(Feed(loaded, connect, observer)) as feed,
            StopSignals(SteadyClock(), duration) as signals,
        ):
            for warning in feed.warnings:
                _say(warning)
            _say(f"recording in {folder}")
            recorder = NetworkRecorder(folder, loaded.name, loaded.text, states, named)
            try:
                _record(feed, recorder, signals)
            finally:
                recorded = recorder.close()
                for notice in recorder.notices():
                    _say(notice)
        for line in _Strangers(feed).new():
            _say(line)
    for run in recorded:
        OUT.print(_summary(run), soft_wrap=True, highlight=False)
    if not recorded:
        _say("nothing was recorded: no site was heard")
    if not recorded or any(run.unwritten for run in recorded):
        raise typer.Exit(EXIT_NOT_RECORDED)


def _folder(session: Session, out: Path | None, force: bool) -> Path:
    folder = out or Path(f"{session.name}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}")
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written to")
    if not force and any(folder.glob("*.mcap")):
        raise TelemetryError(f"{folder} holds recordings: name another folder, or use --force")
    return folder


def _record(feed: Feed, recorder: NetworkRecorder, signals: StopSignals) -> None:
    strangers, hearing = _Strangers(feed), _Hearing()
    while not signals.asked_to_stop():
        for batch, arrival_ns in feed.receive():
            recorder.offer(batch, arrival_ns)
            hearing.heard(SiteId(batch.site))
        for notice in (*recorder.notices(), *hearing.changes(), *strangers.new()):
            _say(notice)
        time.sleep(POLL_S)


class _Hearing:
    """Which sites are heard, and when that changes."""

    def __init__(self) -> None:
        self._last_s = dict.fromkeys(SiteId, time.monotonic())
        self._silent: set[SiteId] = set()
        self._back: set[SiteId] = set()

    def heard(self, site: SiteId) -> None:
        self._last_s[site] = time.monotonic()
        if site in self._silent:
            self._silent.remove(site)
            self._back.add(site)

    def changes(self) -> list[str]:
        """Return what changed since the last call."""
        late_s = time.monotonic() - SILENT_S
        fallen = {site for site, last_s in self._last_s.items() if last_s < late_s} - self._silent
        self._silent |= fallen
        told = [f"{site.label}: heard again" for site in sorted(self._back)]
        told += [f"{site.label}: nothing heard for {SILENT_S:g} s" for site in sorted(fallen)]
        self._back.clear()
        return told


class _Strangers:
    """What came and is not recorded; each kind is new once."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._told: set[str] = set()

    def new(self) -> list[str]:
        """Return what there is to tell for the first time, with its count up to now."""
        counts = {
            "batches were of another session file and not recorded": self._feed.foreign,
            "payloads were no telemetry of this version and not recorded": self._feed.broken,
        }
        new = {what: count for what, count in counts.items() if count and what not in self._told}
        self._told |= new.keys()
        return [f"{count} {what}" for what, count in new.items()]


def _summary(run: Recorded) -> str:
    gaps = f"{len(run.gaps)} gaps: {_places(run.gaps)}" if run.gaps else "no gap"
    unwritten = f"; {run.unwritten} not written: {run.error}" if run.unwritten else ""
    return f"{run.site}: {run.rows} rows of run {run.epoch}, {gaps}{unwritten}"


def _places(gaps: tuple[Gap, ...]) -> str:
    told = ", ".join(f"{gap.rows} from row {gap.first} on" for gap in gaps[:SHOWN])
    return told + (", …" if len(gaps) > SHOWN else "")


def _say(line: str) -> None:
    ERR.print(line, soft_wrap=True, highlight=False, markup=False)
