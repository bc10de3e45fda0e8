"""`farhand export`: recordings as files of other kinds."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from farhand.console import ERR, OUT, user_errors
from farhand.picture import picture_of
from farhand.recordings import Recordings, SessionFile, TakeNumber, session_of
from hardware.interface import HardwareError
from site_runtime.derived import derivation
from telemetry.dashboard import save_recording
from telemetry.export import write_csv, write_joined, write_parquet
from telemetry.rows import DERIVED, Derive, TelemetryError, nothing_derived
from telemetry.takes import Take, read_take


class Kind(StrEnum):
    """What recordings can be exported to."""

    PARQUET = "parquet"
    CSV = "csv"
    RESULT = "result"
    RRD = "rrd"


def export(
    files: Recordings,
    to: Annotated[
        Kind,
        typer.Option(
            "--to",
            help="parquet, csv: a folder with a table a site. result: one Parquet file, both sites "
            "at the local ticks. rrd: the dashboard, for rerun.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="File or folder to write.")],
    take: TakeNumber = None,
    session: SessionFile = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite what is there.")] = False,
) -> None:
    """Write recordings of one or both sites as Parquet, CSV, a result file, or a rerun file."""
    with user_errors():
        _require_free(out, to, force)
        chosen = read_take(files, take)
        written = [out]
        match to:
            case Kind.PARQUET:
                written = write_parquet(out, chosen, _derivation(chosen, files[0], session))
            case Kind.CSV:
                written = write_csv(out, chosen, _derivation(chosen, files[0], session))
            case Kind.RESULT:
                write_joined(out, chosen, _derivation(chosen, files[0], session))
            case Kind.RRD:
                picture = picture_of(session_of(chosen, files[0], session))
                save_recording(out, picture, chosen.arrivals())
        for path in written:
            OUT.print(f"{path}  {path.stat().st_size / 1e6:.1f} MB", soft_wrap=True, markup=False)


def _derivation(take: Take, recording: Path, original: Path | None) -> Derive:
    """Return what derives columns by the robots of the session, if it is to be had."""
    try:
        return derivation(session_of(take, recording, original))
    except (TelemetryError, HardwareError) as error:
        if original is not None:
            raise
        ERR.print(
            f"{', '.join(DERIVED)} are left out, since the robots are not known: {error}",
            style="yellow",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
        return nothing_derived


def _require_free(out: Path, to: Kind, force: bool) -> None:
    """Find out before the work whether its end can be written."""
    folder = to in (Kind.PARQUET, Kind.CSV)
    if out.exists() and out.is_dir() != folder:
        raise TelemetryError(
            f"{out} is {'no folder' if folder else 'a folder'}: --to {to} writes "
            f"{'a folder' if folder else 'a file'}"
        )
    taken = any(out.iterdir()) if out.is_dir() else out.exists()
    if taken and not force:
        raise TelemetryError(f"{out} exists: name another, or use --force")
    if not folder and not out.absolute().parent.is_dir():
        raise FileNotFoundError(f"--out {out}: there is no folder {out.absolute().parent}")
