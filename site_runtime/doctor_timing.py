"""Whether this machine wakes a loop on time, and whether a tick fits into its period."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from site_runtime.clock import LatenessHistogram, Pacer, SteadyClock
from site_runtime.doctor_findings import Finding, Verdict
from site_runtime.real_time import RealTimeSettings, apply_real_time
from site_runtime.site import Site
from site_runtime.supervisor import DRIVEN

_PUNCTUAL_SHARE = 0.1  # of the period: so late at most, at 99.9 %, is good
_MISSED_SHARE = 1e-3
_ROOMY_SHARE = 0.5  # of the period: so long a tick at most, at 99.9 %, is good
_FULL_SHARE = 0.9
_ENGAGE_S = 10.0
_HELP = (
    "see what was found of kernel, privileges, governor, cores and load; or take a lower rate: "
    "rate_hz under [loop] in the session file, the same at both sites"
)


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late an empty loop woke: p50, p99, p99.9 and the worst [µs], ticks missed and due."""

    percentiles_us: tuple[float, ...]
    missed: int
    ticks: int
    refused: tuple[str, ...]

    @property
    def missed_share(self) -> float:
        """Of the ticks that were due."""
        return self.missed / self.ticks


def measure_lateness(
    period_ns: int, seconds: float, settings: RealTimeSettings, cpu: int | None
) -> Lateness:
    """Run an empty loop on the daemons' clock, with these of their settings as far as granted."""
    clock, lateness = SteadyClock(), LatenessHistogram()
    with apply_real_time(as_granted(settings), cpu) as granted:
        pacer = Pacer(clock, period_ns)
        ticks = max(1, round(seconds * 1e9 / period_ns))
        woken = 0
        while woken + pacer.missed < ticks:
            lateness.add(pacer.wait())
            woken += 1
    return Lateness(
        lateness.percentiles_us(50, 99, 99.9, 100),
        pacer.missed,
        woken + pacer.missed,
        tuple(refusal.asked for refusal in granted.refused),
    )


def as_granted(settings: RealTimeSettings) -> RealTimeSettings:
    """Ask for the same, and run with what is granted: the refusal is a finding, not the end."""
    return replace(settings, mode="try") if settings.mode == "enforce" else settings


def lateness_finding(what: str, measured: Lateness, period_ns: int, *, decisive: bool) -> Finding:
    """Judge lateness against the period; `decisive` where sites are to run so."""
    period_us = period_ns * 1e-3
    _, p99_us, p999_us, _ = measured.percentiles_us
    told = (
        f"{_told(measured.percentiles_us)}; {measured.missed} of {measured.ticks} ticks missed, at "
        f"{1e9 / period_ns:g} Hz"
    )
    if measured.refused:
        told += f"; refused: {', '.join(measured.refused)}"
    if measured.missed_share > _MISSED_SHARE or p99_us > 0.5 * period_us:
        change = _HELP if decisive else "a site here needs SCHED_FIFO, see privileges"
        return Finding(what, Verdict.NOT_GOOD, told, change, decisive)
    if measured.missed or p999_us > _PUNCTUAL_SHARE * period_us:
        return Finding(what, Verdict.WILL_DO, told, "", decisive)
    return Finding(what, Verdict.GOOD, told, "", decisive)


class NotDrivenError(Exception):
    """The sites did not come to drive their robots, so that no tick of theirs tells anything."""


def measure_ticks(
    sites: Sequence[Site], clock: SteadyClock, period_ns: int, seconds: float
) -> tuple[LatenessHistogram, ...]:
    """Let sites tick in turn at their rate; return how long each one's ticks took once driving.

    Raises NotDrivenError if one fails, or none drives within 10 s.
    """
    taken = tuple(LatenessHistogram() for _ in sites)
    pacer = Pacer(clock, period_ns)
    end_ns = clock.now_ns() + round(_ENGAGE_S * 1e9)
    driving = False
    opened: list[Site] = []
    try:
        for site in sites:
            site.open()
            opened.append(site)
        while clock.now_ns() < end_ns:
            pacer.wait()
            for site, histogram in zip(sites, taken, strict=True):
                start_ns = time.perf_counter_ns()
                site.tick()
                if driving:
                    histogram.add(time.perf_counter_ns() - start_ns)
                site.telemetry.flush()
                if site.failure is not None:
                    raise NotDrivenError(f"the {site.identity.label} site failed: {site.failure}")
            if not driving and all(site.state in DRIVEN for site in sites):
                driving = True
                end_ns = clock.now_ns() + round(seconds * 1e9)
    finally:
        for site in opened:
            site.close()
    if not driving:
        raise NotDrivenError(
            f"within {_ENGAGE_S:g} s the sites did not engage: "
            + ", ".join(f"{site.identity.label} {site.cause.value}" for site in sites)
        )
    return taken


def tick_finding(what: str, taken: LatenessHistogram, period_ns: int) -> Finding:
    """Judge how long ticks took against the period."""
    percentiles_us = taken.percentiles_us(50, 99, 99.9, 100)
    _, p99_us, p999_us, _ = percentiles_us
    period_us = period_ns * 1e-3
    told = f"{_told(percentiles_us)}, of a period of {period_us:g} µs"
    if p999_us <= _ROOMY_SHARE * period_us:
        return Finding(what, Verdict.GOOD, told, "", decisive=True)
    if p99_us <= _FULL_SHARE * period_us:
        return Finding(what, Verdict.WILL_DO, told, "", decisive=True)
    rate_hz = max(1, int(_ROOMY_SHARE * 1e6 / p99_us))
    change = f"rate_hz = {rate_hz} under [loop] in the session file, or a faster machine"
    return Finding(what, Verdict.NOT_GOOD, told, change, decisive=True)


def _told(percentiles_us: tuple[float, ...]) -> str:
    p50, p99, p999, worst = percentiles_us
    return f"p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f}, worst {worst:.0f} µs"
