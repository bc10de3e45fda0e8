"""`farhand certify`."""

from collections.abc import Mapping

import typer
from rich.markup import escape
from rich.table import Table

from control_law import sampling
from control_law.certificates import Theorem
from farhand.console import OUT, say, user_errors
from site_runtime.advice import Overload, Remedy, remedies
from site_runtime.certification import (
    Bound,
    Certification,
    SamplingRatio,
    sampling_ratio,
)
from site_runtime.certification import certify as certify_session
from site_runtime.daemon import SessionPath
from site_runtime.keys import SiteId
from site_runtime.pose_search import POSES
from site_runtime.rounding import rounded_down
from site_runtime.session import Session, load_session

EXIT_NOT_CERTIFIED = 1

# x_l, x_r: each site's damping over the stiffness
_STATEMENTS: Mapping[Theorem, str] = {
    Theorem.PAPER: "Λ_min > 2 (T + 2h) Ω_max β reach² at each site, by the joint damping",
    Theorem.A: "(1/μ_l − h)(1/μ_r − h) > (T/2)², 1/μ = 1 / (K_max Σ reach²/λ) of the joint damping",
    Theorem.B: "(D_l/K − h)(D_r/K − h) > (T/2)² on every task axis, D the task damping",
}


def certify(session: SessionPath) -> None:
    """Say which round trip the gains are proven for. Exit code 1 if the session's is longer."""
    with user_errors():
        loaded = load_session(session)
        result = certify_session(loaded)
        ratios = [sampling_ratio(loaded, site) for site in SiteId]
        changes = remedies(loaded) if result.margin_s <= 0.0 else ()
    print_certificates(loaded, result)
    print_sampling(loaded, ratios)
    if result.margin_s > 0.0:
        say(f"[green]certified[/green] by {_by(loaded, result)}")
        return
    say(
        f"[red]not certified[/red]: {-result.margin_s * 1e3:.1f} ms short, by {_by(loaded, result)}"
    )
    _print_remedies(loaded, changes)
    raise typer.Exit(EXIT_NOT_CERTIFIED)


def print_certificates(session: Session, result: Certification) -> None:
    """Print what each theorem certifies, and the margin to what the session injects."""
    table = Table(title=f"session {session.name}", title_justify="left")
    for heading in ("condition", "certified round trip", "why no more"):
        table.add_column(heading)
    for certificate in result.certificates:
        used = certificate.theorem == result.best.theorem
        table.add_row(
            certificate.theorem,
            f"{certificate.round_trip_s * 1e3:.1f} ms",
            certificate.reason,
            style="bold green" if used and result.margin_s > 0.0 else None,
        )
    OUT.print(table)
    say(
        f"round trip injected by this session: {result.injected_round_trip_s * 1e3:.1f} ms at most "
        f"(packet spacing and ticks included, the network's own delay not); "
        f"margin {result.margin_s * 1e3:.1f} ms"
    )
    if any(
        direction.loss is not None
        for direction in (session.channel.local_to_remote, session.channel.remote_to_local)
    ):
        say("[yellow]losses are not in it[/yellow]: a burst adds its length to the round trip")


def print_sampling(session: Session, ratios: list[SamplingRatio]) -> None:
    """Print what the loop's rate makes of the damping."""
    say(
        f"sampling at {session.loop.rate_hz} Hz, a = T_s·λ_max(M⁻¹Λ) at the worst pose that a "
        f"search of {POSES} found; a stays stable below {sampling.LIMIT_IMMEDIATE:g}, "
        f"below {sampling.LIMIT_LATE_EXACT:g} with torque one tick late, below "
        f"{sampling.LIMIT_LATE_DIFFERENCE:.3f} with differenced velocity too:"
    )
    for ratio in ratios:
        verdict, colour = "as advised, at most", "green"
        if not ratio.ratio <= sampling.ADVISED_RATIO:
            verdict, colour = "above the advised", "yellow"
        if not ratio.stable:
            verdict, colour = "UNSTABLE with one tick of latency, above the advised", "red"
        pose = "" if ratio.advised else f", at {numbers(ratio.pose_rad, 2)} rad"
        say(
            f"  {ratio.site.label}: a = {ratio.ratio:.3f}, [{colour}]{verdict} "
            f"{sampling.ADVISED_RATIO}[/{colour}]{escape(pose)}"
        )
        if ratio.filter_ratio is not None:
            good = ratio.filter_ratio <= sampling.ADVISED_FILTER_RATIO
            verdict, colour = (
                ("as advised, at most", "green") if good else ("above the advised", "yellow")
            )
            say(
                f"  {ratio.site.label}: velocity filter, τ_f·λ_max(M⁻¹Λ) = "
                f"{ratio.filter_ratio:.3f}, "
                f"[{colour}]{verdict} {sampling.ADVISED_FILTER_RATIO}[/{colour}]"
            )


def _by(session: Session, result: Certification) -> str:
    hold_ms = session.period_ns * 1e-6
    theorem = result.best.theorem
    return f"{theorem}: {_STATEMENTS[theorem]}; h = {hold_ms:g} ms, the tick"


def _print_remedies(session: Session, found: tuple[Remedy, ...]) -> None:
    good = [remedy for remedy in found if not remedy.overloads]
    bad = [remedy for remedy in found if remedy.overloads]
    if good:
        say("what would certify it, the smallest change first:")
    for number, remedy in enumerate(good, start=1):
        bold = "bold" if number == 1 else "default"
        say(f"  {number}. [{bold}]{escape(_changes(remedy))}[/{bold}] {_outcome(remedy)}")
    if not good:
        say("no single change would certify it within the advised sampling limits:")
    for remedy in bad:
        say(f"  [yellow]not advised[/yellow]: {escape(_changes(remedy))} {_outcome(remedy)}")
        for overload in remedy.overloads:
            say(f"     but {escape(_overload(session, overload))}")
    if not found:
        say("  lower the stiffness and the round trip, and raise the damping")


def _changes(remedy: Remedy) -> str:
    verb = "raise" if remedy.changes[0].raised else "lower"
    values = (f"{c.key} from {_value(c.old)} to {_value(c.new)}" for c in remedy.changes)
    return f"{verb} {' and '.join(values)}"


def _outcome(remedy: Remedy) -> str:
    best = remedy.certification.best
    margin_ms = remedy.certification.margin_s * 1e3
    return (
        f"({best.theorem} then certifies {best.round_trip_s * 1e3:.1f} ms, "
        f"margin {margin_ms:.2g} ms)"
    )


def _overload(session: Session, overload: Overload) -> str:
    limit, mode = overload.limit, overload.mode
    if limit.bound is Bound.SAMPLING:
        what = f"{session.loop.rate_hz} Hz"
        mend = (
            f"raise loop.rate_hz to {overload.rate_hz} at least"
            if overload.rate_hz is not None
            else "no loop rate carries it"
        )
        excess = f"a = {limit.period_s * mode.rate_per_s:.2f} at {numbers(mode.pose_rad, 2)} rad"
    else:
        filter_s = sampling.ADVISED_FILTER_RATIO / mode.rate_per_s
        what = f"the velocity filter of {limit.filter_s:g} s"
        mend = f"shorten it to {rounded_down(filter_s, 2):g} s at most"
        excess = f"τ_f·λ = {(limit.filter_s or 0.0) * mode.rate_per_s:.2f}"
    if overload.carried is None:
        return f"{what} carries none of it beside the rest ({excess}): {mend}, or lower the rest"
    return f"{what} carries only {overload.key} ≤ {_value(overload.carried)} ({excess}): {mend}"


def _value(value: float | tuple[float, ...]) -> str:
    return numbers(value) if isinstance(value, tuple) else f"{value:.10g}"


def numbers(values: tuple[float, ...], decimals: int | None = None) -> str:
    """Write a list as the session file has it, or rounded."""
    if decimals is not None:
        values = tuple(round(value, decimals) + 0.0 for value in values)  # no −0
    return f"[{', '.join(format(value, '.10g') for value in values)}]"
