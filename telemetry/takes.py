"""What both sites recorded of one stretch of a session, on one timeline."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from telemetry.recorded_runs import recorded_runs, recording_files
from telemetry.recording import Recording
from telemetry.rows import RowArray, TelemetryError, row_dtype
from telemetry.stream import Batch

IntArray = npt.NDArray[np.int64]

SITES: Final = ("local", "remote")
BATCH_ROWS: Final = 50
JOIN_WITHIN_NS: Final = 100_000_000


@dataclass(frozen=True, slots=True)
class Take:
    """Runs of one session that overlap in time, in the order of their first rows.

    Usually one of each site; a site that was started again has several, one not recorded none.
    Times are the session's, as the dashboard shows them: `time_ns` of the run that gives the time,
    the local site's first if there is one.
    """

    runs: tuple[Recording, ...]

    @property
    def metadata(self) -> Mapping[str, str]:
        """What was said about the first run."""
        return self.runs[0].metadata

    @property
    def session_text(self) -> str:
        """The session file as it was recorded."""
        return self.runs[0].session_text

    def of(self, site: str) -> tuple[Recording, ...]:
        """Return the runs of one site."""
        return tuple(run for run in self.runs if run.metadata["site"] == site)

    @property
    def zero_wall_ns(self) -> int:
        """Wall clock at session time zero [ns since 1970]."""
        timekeeper = self._timekeeper
        return int(timekeeper.wall_times_ns[0]) - int(timekeeper.rows["time_ns"][0])

    def offset_ns(self, run: Recording) -> int:
        """Return what put on a stamp of one of its runs gives session time [ns].

        By the wall clocks; unless the timekeeper measured, to within less, that they disagree.
        """
        timekeeper, offset_ns = self._timekeeper, int(run.metadata["wall_offset_ns"])
        if run.metadata["site"] != timekeeper.metadata["site"]:
            rows = timekeeper.rows
            known = rows[rows["clock_uncertainty_ns"] >= 0]
            if len(known):
                measured_ns = int(np.median(known["clock_offset_ns"]))
                measured_ns += int(timekeeper.metadata["wall_offset_ns"])
                if abs(measured_ns - offset_ns) > np.median(known["clock_uncertainty_ns"]):
                    offset_ns = measured_ns
        return offset_ns - self.zero_wall_ns

    def times_ns(self, run: Recording) -> IntArray:
        """Session time (r,) [ns] of the rows of one of its runs."""
        times: IntArray = run.rows["stamp_ns"] + self.offset_ns(run)
        return times

    @property
    def _timekeeper(self) -> Recording:
        return (self.of("local") or self.runs)[0]

    @property
    def span_ns(self) -> tuple[int, int]:
        """Session time of the first and of the last row [ns]."""
        times_ns = [self.times_ns(run) for run in self.runs]
        return min(int(t[0]) for t in times_ns), max(int(t[-1]) for t in times_ns)

    def arrivals(self, start_ns: int | None = None) -> list[tuple[Batch, int]]:
        """Return (batch, session time of its newest row [ns]), as they came live, in this order.

        With `start_ns`, of rows from this session time on.
        """
        found = []
        for run in self.runs:
            site, digest = SITES.index(run.metadata["site"]), int(run.metadata["digest"], 16)
            times_ns = self.times_ns(run)
            first = 0 if start_ns is None else int(np.searchsorted(times_ns, start_ns))
            joints, dimension = run.rows["q"].shape[1], run.rows["position_m"].shape[1]
            epoch = int(run.metadata["epoch"])
            for begin in range(first, len(run.rows), BATCH_ROWS):
                rows = run.rows[begin : begin + BATCH_ROWS]
                batch = Batch(site, joints, dimension, digest, epoch, rows)
                found.append((batch, int(times_ns[begin + len(rows) - 1])))
        return sorted(found, key=lambda arrival: arrival[1])


def read_take(paths: Sequence[Path], number: int | None = None) -> Take:
    """Read recordings, or folders of them, as one take; `number` chooses from several, from 1.

    TelemetryError if they hold no rows, rows of another version or of several sessions, or several
    takes and no number.
    """
    runs = recorded_runs(recording_files(paths))
    if not runs:
        raise TelemetryError(f"{', '.join(map(str, paths))}: no row was recorded")
    _require_one_session(runs)
    _require_this_layout(runs)
    takes = _takes(runs)
    if number is None and len(takes) > 1:
        listed = "\n".join(f"  {i}: {describe(take)}" for i, take in enumerate(takes, 1))
        raise TelemetryError(
            f"these recordings hold {len(takes)} takes, stretches of time apart:\n{listed}\n"
            "choose one by its number (--take), or give its files alone"
        )
    if number is not None and not 1 <= number <= len(takes):
        raise TelemetryError(f"take {number}: these recordings hold takes 1 to {len(takes)}")
    return takes[(number or 1) - 1]


def describe(take: Take) -> str:
    """Tell in a line when a take was recorded, for how long, and of which sites."""
    start_ns, end_ns = take.span_ns
    start = datetime.fromtimestamp((start_ns + take.zero_wall_ns) // 10**9, UTC)
    runs = ", ".join(f"{run.metadata['site']} {len(run.rows)} rows" for run in take.runs)
    return f"{start:%Y-%m-%d %H:%M:%S} UTC, {(end_ns - start_ns) * 1e-9:.1f} s: {runs}"


def joined_rows(take: Take) -> tuple[RowArray, RowArray]:
    """Return the local rows and, for each, the newest remote row of then; both (r,).

    Nothing is interpolated: a remote row may come twice, or not at all. The ticks are the local
    site's; those that have no remote row of the last 100 ms are left out. TelemetryError unless
    there is one run of each site.
    """
    pair = [take.of(site) for site in SITES]
    if [len(runs) for runs in pair] != [1, 1]:
        counts = " and ".join(f"{len(r)} {s}" for s, r in zip(SITES, pair, strict=True))
        raise TelemetryError(f"{counts} runs were recorded: joining takes one of each site")
    (local,), (remote,) = pair
    local_ns, remote_ns = take.times_ns(local), take.times_ns(remote)
    newest = np.searchsorted(remote_ns, local_ns, side="right") - 1
    known = (newest >= 0) & (local_ns - remote_ns[newest] <= JOIN_WITHIN_NS)
    return local.rows[known], remote.rows[newest[known]]


def _takes(runs: Sequence[Recording]) -> list[Take]:
    """Split runs, in the order of their starts, where none overlaps."""
    takes: list[list[Recording]] = []
    end_ns = 0
    for run in runs:
        first_ns, last_ns = int(run.wall_times_ns[0]), int(run.wall_times_ns[-1])
        if not takes or first_ns > end_ns:
            takes.append([])
        takes[-1].append(run)
        end_ns = max(end_ns, last_ns)
    return [Take(tuple(take)) for take in takes]


def _require_one_session(runs: Sequence[Recording]) -> None:
    sessions = {run.metadata["digest"]: run.metadata["session"] for run in runs}
    if len(sessions) > 1:
        told = ", ".join(f"{name} ({digest})" for digest, name in sessions.items())
        raise TelemetryError(f"the recordings are of different sessions: {told}; give those of one")


def _require_this_layout(runs: Sequence[Recording]) -> None:
    for run in runs:
        joints, dimension = int(run.metadata["joints"]), int(run.metadata["dimension"])
        if run.rows.dtype != row_dtype(joints, dimension):
            version = run.metadata.get("layout_version", "?")
            raise TelemetryError(
                f"the recording of the {run.metadata['site']} site has rows of layout version "
                f"{version}: read it with the version of farhand that wrote it, "
                f"{run.metadata.get('farhand', 'unknown')}"
            )
