"""`farhand certify`."""

import typer
from rich.table import Table

from control_law import sampling
from farhand.console import OUT, user_errors
from site_runtime.certification import certify as certify_session
from site_runtime.certification import sampling_ratio
from site_runtime.daemon import SessionPath
from site_runtime.keys import SiteId
from site_runtime.session import load_session

EXIT_NOT_CERTIFIED = 1


def certify(session: SessionPath) -> None:
    """Say which round trip the gains are proven for. Exit code 1 if the session's is longer."""
    with user_errors():
        loaded = load_session(session)
        result = certify_session(loaded)
        ratios = [sampling_ratio(loaded, site) for site in SiteId]
    table = Table(title=f"session {loaded.name}", title_justify="left")
    for heading in ("condition", "certified round trip", "why no more"):
        table.add_column(heading)
    for certificate in result.certificates:
        best = certificate.theorem == result.best.theorem
        table.add_row(
            certificate.theorem,
            f"{certificate.round_trip_s * 1e3:.1f} ms",
            certificate.reason,
            style="bold green" if best and result.margin_s > 0.0 else None,
        )
    OUT.print(table)
    OUT.print(
        f"injected by this session: {result.injected_round_trip_s * 1e3:.1f} ms at most "
        f"(packet spacing and ticks included, the network's own delay not); "
        f"margin {result.margin_s * 1e3:.1f} ms"
    )
    for ratio in ratios:
        verdict = "as advised" if ratio.advised else "above the advised"
        colour = "green" if ratio.advised else "yellow"
        if not ratio.stable:
            verdict, colour = "UNSTABLE with one tick of latency, above the advised", "red"
        OUT.print(
            f"sampling at {loaded.loop.rate_hz} Hz, {ratio.site.label}: "
            f"T_s·λ_max(M⁻¹Λ) = {ratio.ratio:.3f}, [{colour}]{verdict} {sampling.ADVISED_RATIO}"
            f"[/{colour}] (limits: {sampling.LIMIT_IMMEDIATE:g} at once, "
            f"{sampling.LIMIT_LATE_DIFFERENCE:.3f} one tick late)"
        )
    if result.margin_s <= 0.0:
        OUT.print("[red]not certified[/red]: raise the damping; or lower stiffness or delay")
        raise typer.Exit(EXIT_NOT_CERTIFIED)
    OUT.print(f"[green]certified[/green] by {result.best.theorem}")
