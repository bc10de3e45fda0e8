"""`farhand recompute`: a recorded run computed again, to be verified or with other gains."""

import json
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from farhand.console import ERR, OUT, say, user_errors
from farhand.recordings import Recordings, TakeNumber, session_of
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.keys import SiteId
from site_runtime.recomputation import Recomputed, recompute_law, whole
from site_runtime.recomputation import recompute as recompute_run
from site_runtime.session import Session, load_session
from telemetry.piece import Piece
from telemetry.recording import Recording, RecordingSource, RecordingWriter
from telemetry.rows import COLUMNS, TelemetryError
from telemetry.segments import segment_path
from telemetry.takes import read_take

BUILD = {SiteId.LOCAL: build_local_site, SiteId.REMOTE: build_remote_site}
COMPUTING = ("farhand", "numpy", "pin")
EXIT_DIFFERS = 1
_PIECE_ROWS = 1000


def recompute(
    files: Recordings,
    session: Annotated[
        Path | None,
        typer.Option(
            "--session",
            help="Another session file: what would it have commanded? Or the original, where it "
            "names files that are not here.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for what was computed, as recordings."),
    ] = None,
    take: TakeNumber = None,
) -> None:
    """Feed what a site read and heard to the same code again; verify its commands bit by bit.

    Exit code 1 if a command differs. A run recorded from its start is computed from the packets
    on; of a part of one, each command is computed from its reading and the point to follow.
    """
    with user_errors():
        chosen = read_take(files, take)
        other = None if session is None else load_session(session)
        if other is not None and f"{other.digest:016x}" == chosen.metadata["digest"]:
            other = None
        own = session_of(chosen, files[0], None if other is not None else session)
        if other is not None:
            _require_alike(own, other)
        differs = False
        for run in chosen.runs:
            result = _recomputed(run, other or own)
            if other is None:
                differs |= _tell_verdict(run, result)
            else:
                OUT.print(_what_if(run, result))
            if out is not None:
                path = _write(out, run, result, other or own)
                say(f"[bold]written[/bold]    {path}")
    if differs:
        raise typer.Exit(EXIT_DIFFERS)


def _recomputed(run: Recording, session: Session) -> Recomputed:
    """Compute a run, with a bar for whoever waits."""
    site = SiteId[run.metadata["site"].upper()]
    why_not = whole(run)
    if why_not:
        say(
            f"[yellow]{site.label} site:[/yellow] {why_not}: not computed from the packets on, "
            "but each command from its reading and the point to follow"
        )
        return recompute_law(run, session, BUILD[site])
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    quiet = not ERR.is_terminal
    with Progress(*columns, TimeRemainingColumn(), console=ERR, disable=quiet) as bar:
        task = bar.add_task(f"{site.label} site", total=len(run.rows))
        return recompute_run(
            run, session, BUILD[site], lambda ticks: bar.update(task, completed=ticks)
        )


def _tell_verdict(run: Recording, result: Recomputed) -> bool:
    """Say whether what was computed is what was recorded; return whether it is not."""
    site, rows = run.metadata["site"], len(result.computed)
    differing = result.differing
    if not differing:
        say(
            f"[bold]{site} site[/bold]  {rows} rows, {len(result.columns)} columns, torques among "
            "them: [green]bit by bit as recorded[/green]"
        )
        return False
    for name, there, here in _other_programs(run):
        say(f"[yellow]{site} site:[/yellow] recorded with {name} {there}, this is {here}")
    table = Table(title=f"{site} site: not as recorded", title_justify="left")
    for heading in ("column", "rows", "first at", "greatest difference"):
        table.add_column(heading)
    for name, count in differing.items():
        first = result.recorded[np.flatnonzero(result.differs(name))[0]]
        gap = np.abs(
            result.computed[name].astype(np.float64) - result.recorded[name].astype(np.float64)
        )
        greatest = float(np.nanmax(gap)) if np.isfinite(gap).any() else np.nan
        table.add_row(
            name,
            f"{count} of {rows}",
            f"row {first['sequence']}, {first['time_ns'] * 1e-9:.3f} s",
            f"{greatest:.3g} {COLUMNS[name].unit}",
        )
    OUT.print(table)
    return True


def _other_programs(run: Recording) -> list[tuple[str, str, str]]:
    """Programs that compute, recorded in another version than this one."""
    return [
        (name, there, version(name))
        for name in COMPUTING
        if (there := run.metadata.get(name, "")) and there != version(name)
    ]


def _what_if(run: Recording, result: Recomputed) -> Table:
    """Compare the torques of another session with those that were commanded."""
    recorded, computed = result.recorded, result.computed
    table = Table(
        title=f"{run.metadata['site']} site, {len(computed)} rows at the same readings and packets",
        title_justify="left",
    )
    for heading in ("torque [N·m]", "recorded rms", "other rms", "difference rms", "greatest"):
        table.add_column(heading)
    for joint in range(recorded["torque_nm"].shape[1]):
        was, would = recorded["torque_nm"][:, joint], computed["torque_nm"][:, joint]
        gap = would - was
        table.add_row(
            f"joint {joint + 1}",
            *(f"{np.sqrt(np.mean(np.square(x))):.4f}" for x in (was, would, gap)),
            f"{np.abs(gap).max():.4f}",
        )
    was_n, would_n = (
        np.linalg.norm(rows["coupling_force_n"], axis=1) for rows in (recorded, computed)
    )
    table.add_row(
        "coupling [N]",
        *(f"{np.sqrt(np.mean(np.square(x))):.4f}" for x in (was_n, would_n, would_n - was_n)),
        f"{np.abs(would_n - was_n).max():.4f}",
    )
    if "state" in result.columns:
        names = json.loads(run.metadata["states"])
        other = np.flatnonzero(result.differs("state"))
        told = "none"
        if len(other):
            first = computed[other[0]]
            told = (
                f"{len(other)} rows, the first at {first['time_ns'] * 1e-9:.3f} s: "
                f"{names[str(first['state'])]}"
            )
        table.caption = f"another state in {told}"
    return table


def _require_alike(own: Session, other: Session) -> None:
    """Refuse a session whose sites cannot take what was read."""
    for site in SiteId:
        pair = [(s.site(site).robot, s.task.dimension) for s in (own, other)]
        if pair[0] != pair[1]:
            raise TelemetryError(
                f"the {site.label} robot or the task of the other session is not the recorded one: "
                "its readings would mean something else"
            )


def _write(folder: Path, run: Recording, result: Recomputed, session: Session) -> Path:
    """Write computed rows as a recording of their own."""
    metadata = dict(run.metadata) | {"source": "recomputed", "digest": f"{session.digest:016x}"}
    site, offset_ns = metadata["site"], int(metadata["wall_offset_ns"])
    folder.mkdir(parents=True, exist_ok=True)
    path = segment_path(folder, site, int(run.wall_times_ns[0]))
    shape = int(metadata["joints"]), int(metadata["dimension"])
    writer = RecordingWriter(path, RecordingSource(site, *shape, offset_ns, session.text, metadata))
    for start in range(0, len(result.computed), _PIECE_ROWS):
        writer.write(Piece(result.computed[start : start + _PIECE_ROWS], ()))
        writer.flush()
    writer.close()
    return path
