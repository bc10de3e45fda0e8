"""`farhand design`."""

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from control_law import sampling
from farhand.certify import numbers, print_certificates, print_sampling
from farhand.console import say, user_errors
from site_runtime.certification import Bound, certify, injected_round_trip_s, sampling_ratio
from site_runtime.design import Capacity, Design, NoDesign, Wish
from site_runtime.design import design as design_gains
from site_runtime.keys import SiteId
from site_runtime.session import Session, SessionError, load_session
from site_runtime.session_edit import edited, paths_from
from site_runtime.session_settings import MOST_HZ

EXIT_NO_DESIGN = 1


def design(
    base: Annotated[
        Path, typer.Argument(metavar="BASE.toml", help="Session with the robots, rate and devices.")
    ],
    round_trip: Annotated[
        float, typer.Option("--round-trip", help="Round trip to tolerate, ticks included [s].")
    ],
    stiffness: Annotated[
        float, typer.Option("--stiffness", help="How stiff the other side shall feel [N/m].")
    ],
    out: Annotated[Path, typer.Option("--out", help="Session file to write, named by its stem.")],
    force_ceiling: Annotated[
        float | None,
        typer.Option(
            "--force-ceiling",
            help="Force never exceeded [N]. Left out: the base's, else 0.1 m times the stiffness.",
        ),
    ] = None,
    margin: Annotated[
        float, typer.Option("--margin", help="Multiplies the damping that the round trip needs.")
    ] = 1.2,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> None:
    """Choose certified gains for the robots of a session. Exit code 1 if there are none."""
    with user_errors():
        _check_out(out, force)
        session = load_session(base)
        wish = Wish(round_trip, stiffness, margin, force_ceiling)
        found = design_gains(session, wish)
        if isinstance(found, NoDesign):
            _print_why(session, wish, found)
            raise typer.Exit(EXIT_NO_DESIGN)
        _write(session, found, out)
        written = load_session(out)
        result = certify(written)
        ratios = [sampling_ratio(written, site) for site in SiteId]
    print_certificates(written, result)
    print_sampling(written, ratios)
    _print_gains(written)
    certified_s = result.best.round_trip_s
    wanted_s = wish.margin * wish.round_trip_s
    if certified_s < wanted_s or not all(ratio.advised for ratio in ratios):
        raise AssertionError(f"{out} was written, but is not what was wanted")
    say(
        f"[green]{escape(str(out))} is certified[/green] by {result.best.theorem} for "
        f"{certified_s * 1e3:.1f} ms; wanted {wish.round_trip_s * 1e3:g} ms"
    )
    injected_s = injected_round_trip_s(written)
    if injected_s > wish.round_trip_s:
        still = "still certified" if result.margin_s > 0.0 else "not certified"
        say(
            f"[yellow]this session injects up to {injected_s * 1e3:.1f} ms, more than wanted"
            f"[/yellow]: with that it is {still}"
        )


def _check_out(out: Path, force: bool) -> None:
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", out.stem):
        raise SessionError(
            f"--out {out}: the file's stem names the session; 1 to 64 letters, digits, - and _"
        )
    if out.exists() and not force:
        raise FileExistsError(f"--out {out} exists; --force overwrites it")
    if not out.absolute().parent.is_dir():
        raise FileNotFoundError(f"--out {out}: there is no folder {out.absolute().parent}")


def _write(session: Session, found: Design, out: Path) -> None:
    changes = {"name": out.stem, **found.changes(), **paths_from(session, out.absolute().parent)}
    out.write_text(edited(session.text, changes), encoding="utf-8")


def _print_gains(session: Session) -> None:
    coupling = session.coupling
    if coupling.law == "stiffness":
        say(
            f"coupling: stiffness {escape(numbers(coupling.stiffness_n_per_m))} N/m, "
            f"force ceiling {escape(numbers(coupling.force_ceiling_n))} N"
        )
    for site in SiteId:
        damping = session.site(site).damping
        say(
            f"{site.label}.damping: task {escape(numbers(damping.task_n_s_per_m))} N·s/m, "
            f"joint {escape(numbers(damping.joint_nm_s))} N·m·s/rad"
        )


def _print_why(session: Session, wish: Wish, why: NoDesign) -> None:
    say(
        f"[red]there are no such gains[/red]: a round trip of {wish.round_trip_s * 1e3:g} ms at "
        f"{wish.stiffness_n_per_m:g} N/m with margin {wish.margin:g} asks for a task damping of "
        f"{why.wanted_n_s_per_m:.3g} N·s/m at each site, or less at one for more at the other;"
    )
    for capacity in (why.local, why.remote):
        say(f"  {escape(_capacity(session, capacity))}")
    say("what would exist, all else kept:")
    say(f"  --stiffness {why.stiffness_n_per_m:.10g}")
    if why.round_trip_s is not None:
        say(f"  --round-trip {why.round_trip_s:.10g}")
    if why.rate_hz is not None:
        say(f"  loop.rate_hz = {why.rate_hz} in {escape(str(session.path))}")
    else:
        say(f"  no loop rate up to {MOST_HZ} Hz")


def _capacity(session: Session, capacity: Capacity) -> str:
    limit, pose = capacity.limit, numbers(capacity.mode.pose_rad, 2)
    if limit.bound is Bound.SAMPLING:
        what = f"{session.loop.rate_hz} Hz (T_s·λ_max(M⁻¹Λ) ≤ {sampling.ADVISED_RATIO})"
    else:
        what = (
            f"a velocity filter of {limit.filter_s:g} s "
            f"(τ_f·λ_max(M⁻¹Λ) ≤ {sampling.ADVISED_FILTER_RATIO})"
        )
    return (
        f"{limit.site.label} carries {capacity.damping_n_s_per_m:.3g} N·s/m at {what}; "
        f"its worst pose is {pose} rad"
    )
