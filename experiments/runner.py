"""Many cases: on all cores of this machine, or through a dask scheduler; what is done is kept."""

import hashlib
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
)
from contextlib import contextmanager
from io import BytesIO
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread

from experiments.case import Case, Outcome, read_outcome, run_case
from telemetry.result_file import read_result

_ANSWERS_WITHIN = "10s"


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

    Each is kept as a result file, `name`.parquet, with a checksum beside it, `name`.seal.
    `workers` processes here (None: one a core), or those behind the dask `scheduler` address; the
    files written are the same either way. `done` is told of each. Stopped, by Ctrl-C or by what a
    case raised, it keeps what is finished, drops the rest, and goes on from there the next time.
    Raises RunnerError for two different cases of one name, SessionFileError for a bad case, before
    anything runs; RunnerError also for workers lost or with other code.
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
            with _ctrl_c_held_back():
                pending = {executor.submit(run_case, case): case for case in missing}
            for future in as_completed(pending):
                case = pending[future]
                _write(files[case.name], _result(future), fingerprints[case.name])
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
    """Whether a file is this very case's outcome, by this very code, whole and undamaged."""
    seal = _seal_file(file)
    if not (file.exists() and seal.exists()):
        return False
    return seal.read_bytes() == _seal(file.read_bytes(), fingerprint)


def _result(future: Future[bytes]) -> bytes:
    try:
        return future.result()
    except (BrokenExecutor, CancelledError) as error:
        raise RunnerError(
            "workers were lost: ended from outside, out of memory, or their scheduler is gone; "
            "start again to go on with the runs that are missing"
        ) from error


def _write(file: Path, content: bytes, fingerprint: str) -> None:
    """Write whole or not at all, and only what this code would have given; then seal it."""
    if read_result(BytesIO(content)).metadata["fingerprint"] != fingerprint:
        raise RunnerError(
            f"{file.stem}: the worker has other code, session files or libraries than this "
            "process; install the same farhand everywhere, and leave it alone while it runs"
        )
    partial = file.with_suffix(".partial")
    partial.write_bytes(content)
    partial.replace(file)
    _seal_file(file).write_bytes(_seal(content, fingerprint))


def _seal_file(file: Path) -> Path:
    return file.with_suffix(".seal")


def _seal(content: bytes, fingerprint: str) -> bytes:
    return hashlib.blake2b(content, key=fingerprint.encode(), digest_size=16).hexdigest().encode()


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[Executor]:
    """Open processes here, or a dask cluster; on an error, what is not finished is dropped."""
    if scheduler is None:
        context = get_context("spawn")
        reader, writer = context.Pipe(duplex=False)
        with reader, writer:
            pool = ProcessPoolExecutor(
                workers, mp_context=context, initializer=_end_with, initargs=(reader,)
            )
            try:
                yield pool
            except BaseException:
                writer.close()
                raise
            finally:
                pool.shutdown()
        return
    try:
        from distributed import Client
    except ImportError:
        raise RunnerError(
            "--scheduler needs dask.distributed: install the extra, farhand[cluster]"
        ) from None
    try:
        client = Client(scheduler, timeout=_ANSWERS_WITHIN)
    except (OSError, ValueError) as error:
        raise RunnerError(f"no dask scheduler answers at {scheduler}: {error}") from None
    with client:  # closed, it drops what it asked for
        yield client.get_executor()


@contextmanager
def _ctrl_c_held_back() -> Iterator[None]:
    """Hold SIGINT back from the processes that start here: it is the parent's to end them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with(parent: Connection) -> None:
    """Let this process end at once when the parent closes the pipe or is gone, by whatever way."""

    def wait() -> None:
        parent.poll(None)
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def _cores() -> int:
    return len(os.sched_getaffinity(0))
