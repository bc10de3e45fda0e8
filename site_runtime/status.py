"""What a daemon prints: one live line while it runs, a summary when it ends."""

import sys
import threading
import time
from collections.abc import Sequence
from math import isnan
from types import TracebackType

from rich.console import Console
from rich.table import Table
from rich.text import Text

from site_runtime.guard import cut_names
from site_runtime.site import Site
from site_runtime.site_events import Companion, SiteEvents
from site_runtime.supervisor import DRIVEN, Cause, State
from telemetry.recorder_process import RecorderProcess

LIVE_INTERVAL_S = 0.5
LOG_INTERVAL_S = 10.0


class StatusLine:
    """Tells a site's events and prints one line about it, from a thread of its own.

    So a stopped terminal stalls only that. The line is rewritten in place on a terminal twice a
    second; in a log, it comes every ten seconds. `live` says whether it comes at all.
    """

    def __init__(
        self,
        site: Site,
        companions: Sequence[Companion] = (),
        events: SiteEvents | None = None,
        *,
        live: bool = True,
    ) -> None:
        self._site = site
        self._companions = companions
        self._events = events
        self._live = live
        self._in_place = live and sys.stderr.isatty()
        self._interval_s = LIVE_INTERVAL_S if self._in_place else LOG_INTERVAL_S
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def __enter__(self) -> "StatusLine":
        if self._live or self._events is not None:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)
            if self._in_place:
                sys.stderr.write("\n")

    def _run(self) -> None:
        ticks, since_s = self._site.ticks, time.monotonic()
        while not self._ended.wait(min(self._interval_s, LIVE_INTERVAL_S)):
            self._tell_events()
            now_s = time.monotonic()
            if self._live and now_s - since_s >= self._interval_s:
                rate_hz = (self._site.ticks - ticks) / (now_s - since_s)
                self._print_line(rate_hz)
                ticks, since_s = self._site.ticks, now_s
        self._tell_events()

    def _tell_events(self) -> None:
        if self._events is not None:
            self._events.tell()

    def _print_line(self, rate_hz: float) -> None:
        line = describe(self._site, rate_hz, *self._companions)
        sys.stderr.write(f"\r\x1b[K{line}" if self._in_place else f"{line}\n")
        sys.stderr.flush()


def describe(site: Site, rate_hz: float, *companions: Companion) -> str:
    """One line: state, rate, round trip, margin to the certified one, position error, troubles."""
    round_trip_ms = site.round_trip_s * 1e3
    margin_ms = (site.margin.certified_s - site.margin.loop_s) * 1e3
    parts = [f"{site.identity.label:6} {site.state.name:8} {rate_hz:6.0f} Hz"]
    if site.state is not State.ENGAGED:
        parts.append(site.cause.value)
    if site.cause is Cause.APART:
        parts.append(f"{site.apart_m * 1e3:.0f} mm")
    if site.state in DRIVEN and site.scale < 1.0:
        parts.append(f"DE-RATED to {site.scale:.0%}")
    if not isnan(round_trip_ms):
        parts.append(f"round trip {round_trip_ms:6.1f} ms")
    if not isnan(margin_ms):
        parts.append(f"margin {margin_ms:6.1f} ms")
    if site.channel.slowed:
        parts.append(f"sends {1e9 / site.channel.send_period_ns:.0f} Hz")
    if not isnan(site.error_m):
        parts.append(f"error {site.error_m * 1e3:6.1f} mm")
    if site.channel.peer_taken:
        parts.append("the peer obeys ANOTHER site than this one")
    if site.failure is not None:
        parts.append(f"{type(site.failure).__name__}: {site.failure}")
    parts += [trouble for companion in companions if (trouble := companion.trouble) is not None]
    return " · ".join(parts)


def summary(
    site: Site,
    console: Console,
    recorder: RecorderProcess | None = None,
    peer_trouble: str | None = None,
) -> None:
    """Print what the run was: ticks, lateness, packets, cuts, recording, the fault if any."""
    p50, p99, p999, worst = site.lateness.percentiles_us(50, 99, 99.9, 100)
    counters = site.channel.counters
    table = Table(title=f"{site.identity.label} site", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    table.add_row("ticks", f"{site.ticks} run, {site.missed} missed")
    table.add_row(
        "lateness", f"p50 {p50:.0f} · p99 {p99:.0f} · p99.9 {p999:.0f} · worst {worst:.0f} µs"
    )
    table.add_row(
        "packets",
        f"{counters.sent} sent, {counters.send_dropped} dropped here; "
        f"{counters.received} received, {counters.lost} lost, {counters.late} late, "
        f"{counters.rejected.total()} rejected",
    )
    if peer_trouble is not None:
        table.add_row("peer", Text(peer_trouble, style="yellow"))
    if counters.rejected:
        reasons = counters.rejected.most_common()
        table.add_row("rejected", ", ".join(f"{count} {r.name.lower()}" for r, count in reasons))
    cuts = {cut: count for cut, count in site.guard.counts.items() if count}
    if cuts:
        table.add_row(
            "guard cut", ", ".join(f"{cut_names(cut)} in {n} ticks" for cut, n in cuts.items())
        )
    if recorder is not None and recorder.incidents:
        table.add_row("incidents", Text(f"{recorder.incidents} kept in {recorder.folder}"))
    if recorder is not None and recorder.trouble is not None:
        table.add_row("recorder", Text(recorder.trouble, style="red"))
    if site.state is State.FAULT and site.failure is not None:
        failure = f"{type(site.failure).__name__}: {site.failure}"
        table.add_row("FAULT", Text(failure, style="red"))  # no markup: vectors have brackets
    console.print(table)
