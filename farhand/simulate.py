"""`farhand simulate`."""

import platform
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from experiments.measures import settling_time_s
from experiments.simulation import Run, Simulation
from farhand.console import ERR, OUT, user_errors
from site_runtime.daemon import SessionPath
from site_runtime.derived import derivation
from site_runtime.session import Session, load_session
from telemetry.result_file import write_result
from telemetry.rows import DerivedColumns

EXIT_FAULT = 1


def simulate(
    session: SessionPath,
    duration: Annotated[
        float, typer.Option("--duration", help="Session time to simulate [s].", min=0.001)
    ] = 60.0,
    out: Annotated[
        Path | None, typer.Option("--out", help="Result file to write, e.g. run.parquet.")
    ] = None,
) -> None:
    """Run both sites' own code on one manual clock; the same session gives the same bits."""
    with user_errors():
        loaded = load_session(session)
        if out is not None and not out.absolute().parent.is_dir():
            raise FileNotFoundError(f"--out {out}: there is no folder {out.absolute().parent}")
        run = _simulate(loaded, duration)
        if out is not None:
            write_result(out, run.local, run.remote, _provenance(loaded), derivation(loaded))
    if len(run.local):
        _print(run, derivation(loaded)("remote", run.remote["q"]), out)
    if run.failures:
        for failure in run.failures:
            ERR.print(f"FAULT {failure}", style="red", markup=False)
        raise typer.Exit(EXIT_FAULT)


def _simulate(session: Session, duration_s: float) -> Run:
    with Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} s"),
        TimeRemainingColumn(),
        console=ERR,
        transient=True,
    ) as bar:
        task = bar.add_task(session.name, total=duration_s)
        return Simulation(session).run(
            duration_s, lambda time_s: bar.update(task, completed=time_s)
        )


def _provenance(session: Session) -> dict[str, str]:
    """Tell what it takes to repeat the run."""
    versions = {name: version(name) for name in ("farhand", "numpy", "pin")}
    return {
        "session": session.text,
        "session_digest": f"{session.digest:016x}",
        "python": platform.python_version(),
        **versions,
    }


def _print(run: Run, remote: DerivedColumns, out: Path | None) -> None:
    time_s = run.local["time_ns"] * 1e-9
    error_m = np.linalg.norm(run.local["position_m"] - run.remote["position_m"], axis=1)
    table = Table(show_header=False)
    table.add_column(style="bold")
    table.add_column()
    table.add_row("position error", f"{error_m[0] * 1e3:.1f} → {error_m[-1] * 1e3:.3f} mm")
    for limit_m in (0.01, 0.001):
        settled_s = settling_time_s(time_s, error_m, limit_m)
        words = "not reached" if settled_s is None else f"{settled_s:.2f} s"
        table.add_row(f"stays below {limit_m * 1e3:g} mm after", words)
    index = remote["manipulability"]
    table.add_row("remote det(JJᵀ)", f"{index[0]:.4f} → {index[-1]:.4f}")
    if np.isfinite(remote["link_distance_m"]).any():
        table.add_row(
            "nearest to an obstacle",
            f"links {np.nanmin(remote['link_distance_m']):.4f} m, "
            f"midpoints {np.nanmin(remote['midpoint_distance_m']):.4f} m",
        )
    trips_s = run.local["round_trip_s"]
    if np.isfinite(trips_s).any():
        table.add_row(
            "round trip",
            f"{np.nanmin(trips_s) * 1e3:.0f} to {np.nanmax(trips_s) * 1e3:.0f} ms, certified "
            f"{run.local['certified_round_trip_s'][-1] * 1e3:.0f} ms",
        )
    table.add_row("torque, largest", f"{_largest(run, 'torque_nm'):.3f} N·m")
    if out is not None:
        table.add_row("written to", str(out))
    OUT.print(table)


def _largest(run: Run, column: str) -> float:
    return float(max(np.abs(run.local[column]).max(), np.abs(run.remote[column]).max()))
