"""Many cases: on all cores of this machine, or through a dask scheduler; what is done is kept."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from experiments.case import Case, Outcome, read_outcome, run_case
from telemetry.result_file import read_result
from telemetry.rows import TelemetryError


class RunnerError(Exception):
    """Cases that cannot be run as asked."""


def run_cases(
    cases: Iterable[Case],
    folder: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    done: Callable[[Case], None] = lambda case: None,
) -> dict[str, Outcome]:
    """Run cases that `folder` does not hold yet; return all outcomes by name.

    `workers` processes here (None: one a core), or those behind the dask `scheduler` address; the
    files written are the same either way. Interrupted, it goes on where it was. `done` is told of
    each. Raises RunnerError for two different cases of one name, SessionFileError for a bad case,
    before anything runs.
    """
    distinct = _distinct(cases)
    fingerprints = {case.name: case.fingerprint() for case in distinct}
    folder.mkdir(parents=True, exist_ok=True)
    files = {case.name: folder / f"{case.name}.parquet" for case in distinct}
    missing = []
    for case in distinct:
        if _holds(files[case.name], fingerprints[case.name]):
            done(case)
        else:
            missing.append(case)
    if missing:
        missing.sort(key=lambda case: -case.duration_s)  # so that no long one is left to the end
        with _executor(min(workers or _cores(), len(missing)), scheduler) as executor:
            pending = {executor.submit(run_case, case): case for case in missing}
            for future in as_completed(pending):
                case = pending[future]
                _write(files[case.name], future.result())
                done(case)
    return {case.name: read_outcome(case, files[case.name]) for case in distinct}


def _distinct(cases: Iterable[Case]) -> Sequence[Case]:
    """Cases once each, though several studies ask for them."""
    by_name: dict[str, Case] = {}
    for case in cases:
        if by_name.setdefault(case.name, case) != case:
            raise RunnerError(f"two different cases have the name {case.name!r}: rename one")
    return list(by_name.values())


def _holds(file: Path, fingerprint: str) -> bool:
    """Whether a file is this very case's outcome, by this very code."""
    if not file.exists():
        return False
    try:
        return read_result(file).metadata.get("fingerprint") == fingerprint
    except TelemetryError:
        return False


def _write(file: Path, content: bytes) -> None:
    """Write whole or not at all."""
    partial = file.with_suffix(".partial")
    partial.write_bytes(content)
    partial.replace(file)


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[Executor]:
    """Open processes here, or a dask cluster; what has not begun is dropped on an error."""
    if scheduler is None:
        pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
        return
    try:
        from distributed import Client
    except ImportError:
        raise RunnerError(
            "--scheduler needs dask.distributed: install the extra, farhand[cluster]"
        ) from None
    try:
        client = Client(scheduler, timeout="10s")
    except (OSError, ValueError) as error:
        raise RunnerError(f"no dask scheduler answers at {scheduler}: {error}") from None
    with client, client.get_executor() as executor:
        yield executor


def _cores() -> int:
    return len(os.sched_getaffinity(0))
