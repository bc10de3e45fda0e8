"""`farhand export`: recordings as files of other kinds."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from farhand.console import OUT, user_errors
from farhand.picture import picture_of
from farhand.recordings import Recordings, SessionFile, TakeNumber, session_of
from telemetry.dashboard import save_recording
from telemetry.export import write_csv, write_joined, write_parquet
from telemetry.rows import TelemetryError
from telemetry.takes import read_take


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
                written = write_parquet(out, chosen)
            case Kind.CSV:
                written = write_csv(out, chosen)
            case Kind.RESULT:
                write_joined(out, chosen)
            case Kind.RRD:
                picture = picture_of(session_of(chosen, files[0], session))
                save_recording(out, picture, chosen.arrivals())
        for path in written:
            OUT.print(f"{path}  {path.stat().st_size / 1e6:.1f} MB", soft_wrap=True, markup=False)


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
