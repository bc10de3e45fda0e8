"""Many cases: the same files whoever runs them, and nothing finished is run again."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from distributed import Client, LocalCluster
from typer.testing import CliRunner

from experiments import runner
from experiments.case import Case, run_case
from experiments.report import Section
from experiments.runner import RunnerError, run_cases
from experiments.study import Study
from farhand.__main__ import app
from site_runtime.session import SessionFileError

ROOT = Path(__file__).resolve().parents[2]
FIRST = Case("first", "theorems.toml", 0.2, energy_window_s=(0.2, 0.2))
SECOND = Case("second", "demo.toml", 0.15, {"seed": 3}, trace_hz=1000)
FAILING = Case(
    "failing", "figure_2.toml", 0.1, {"remote.device.initial_position_rad": [0.0, 0.0, 0.0]}
)
CASES = (FIRST, SECOND, FAILING)
ENDLESS = Case("endless", "theorems.toml", 1e6)
RAISES = Case("raises", "theorems.toml", 0.1, trace_hz=0)


class Here(Executor):
    """Runs cases at once in this process, and tells which."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.run: Callable[[Case], bytes] = run_case

    def submit(self, _: Callable[..., Any], /, *args: Any, **__: Any) -> Future[Any]:
        (case,) = args
        self.ran.append(case.name)
        future: Future[Any] = Future()
        try:
            future.set_result(self.run(case))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, expected: dict[str, bytes]) -> Here:
    """In place of processes, where it is not processes that are tested; what is known is given."""
    executor = Here()
    executor.run = lambda case: expected[case.name] if case in CASES else run_case(case)

    @contextmanager
    def one(*_: object) -> Iterator[Executor]:
        yield executor

    monkeypatch.setattr(runner, "_executor", one)
    return executor


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    """A dask scheduler with two worker processes."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
    ) as started:
        yield started


@pytest.fixture(scope="module")
def expected() -> dict[str, bytes]:
    return {case.name: run_case(case) for case in CASES}


def kept(folder: Path) -> dict[str, bytes]:
    return {file.stem: file.read_bytes() for file in folder.glob("*.parquet")}


def stamps(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_mtime_ns for file in folder.iterdir()}


# Who runs them


@pytest.mark.parametrize("workers", [1, 2])
def test_processes_give_the_bits_that_one_gives(
    workers: int, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    outcomes = run_cases(CASES, tmp_path, workers=workers)
    assert kept(tmp_path) == expected
    assert list(outcomes) == [case.name for case in CASES]
    assert outcomes["second"].case == SECOND
    assert outcomes["second"].time_s.shape == (151,)
    assert outcomes["failing"].failures
    assert not list(tmp_path.glob("*.partial"))


def test_a_dask_cluster_gives_the_bits_that_one_process_gives(
    cluster: LocalCluster, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    told: list[Case] = []
    run_cases(CASES, tmp_path, scheduler=cluster.scheduler_address, done=told.append)
    assert kept(tmp_path) == expected
    assert sorted(case.name for case in told) == sorted(expected)


def test_all_cores_are_used_unless_told(
    here: Here, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[int, str | None]] = []

    @contextmanager
    def executor(workers: int, scheduler: str | None) -> Iterator[Executor]:
        asked.append((workers, scheduler))
        yield here

    monkeypatch.setattr(runner, "_executor", executor)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 3})
    run_cases(CASES, tmp_path / "a")
    run_cases(CASES, tmp_path / "b", workers=9)  # no more than there is to do
    run_cases(CASES, tmp_path / "c", workers=1, scheduler="tcp://x")
    assert asked == [(2, None), (3, None), (1, "tcp://x")]


# What is kept


def test_what_is_there_is_not_run_again(
    here: Here, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    run_cases(CASES, tmp_path)
    assert here.ran == ["first", "second", "failing"]  # the longest first
    assert kept(tmp_path) == expected
    (tmp_path / "second.parquet").unlink()
    before = stamps(tmp_path)
    here.ran.clear()
    told: list[str] = []
    outcomes = run_cases(CASES, tmp_path, done=lambda case: told.append(case.name))
    assert here.ran == ["second"]
    assert told == ["first", "failing", "second"]
    assert list(outcomes) == ["first", "second", "failing"]
    assert kept(tmp_path) == expected
    after = stamps(tmp_path)
    assert {name for name in after if after[name] != before.get(name)} == {
        *("second.parquet", "second.seal")
    }


def damage(content: bytes, place: float) -> bytes:
    at = int(place * (len(content) - 1))
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


@pytest.mark.parametrize(
    "harm",
    [
        pytest.param(lambda content: b"", id="empty"),
        pytest.param(lambda content: content[: len(content) // 2], id="cut short"),
        pytest.param(lambda content: b"nothing of the kind", id="foreign"),
        pytest.param(lambda content: damage(content, 0.1), id="a bit of its rows"),
        pytest.param(lambda content: damage(content, 0.9), id="a bit of what is said about it"),
    ],
)
@pytest.mark.parametrize("suffix", ["parquet", "seal"])
def test_a_damaged_file_is_run_again(
    harm: Callable[[bytes], bytes],
    suffix: str,
    here: Here,
    tmp_path: Path,
    expected: dict[str, bytes],
) -> None:
    run_cases([FIRST, SECOND], tmp_path)
    file = tmp_path / f"second.{suffix}"
    file.write_bytes(harm(file.read_bytes()))
    here.ran.clear()
    run_cases([FIRST, SECOND], tmp_path)
    assert here.ran == ["second"]
    assert kept(tmp_path)["second"] == expected["second"]


def test_an_unfinished_file_is_never_taken_for_a_result(
    here: Here, tmp_path: Path, expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def pulled_plug(self: Path, content: bytes) -> None:
        with self.open("wb") as file:
            file.write(content[: len(content) // 2])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", pulled_plug)
        with pytest.raises(KeyboardInterrupt):
            run_cases([SECOND], tmp_path)
    assert kept(tmp_path) == {}
    here.ran.clear()
    run_cases([SECOND], tmp_path)
    assert here.ran == ["second"]
    assert kept(tmp_path)["second"] == expected["second"]
    # Whole, but stopped before it was sealed.
    (tmp_path / "second.seal").unlink()
    here.ran.clear()
    run_cases([SECOND], tmp_path)
    assert here.ran == ["second"]


def test_a_changed_case_is_run_again(here: Here, tmp_path: Path) -> None:
    run_cases(CASES, tmp_path)
    before = kept(tmp_path)
    here.ran.clear()
    changed = replace(SECOND, changes={"seed": 3, "coupling.stiffness_n_per_m": [100.0, 100.0]})
    run_cases([FIRST, changed, FAILING], tmp_path)
    assert here.ran == ["second"]
    assert kept(tmp_path)["second"] != before["second"]
    run_cases(CASES, tmp_path)
    assert here.ran == ["second", "second"]
    assert kept(tmp_path) == before


# What is refused


def test_two_different_cases_of_one_name_are_refused(here: Here, tmp_path: Path) -> None:
    with pytest.raises(RunnerError, match="'first'"):
        run_cases([FIRST, SECOND, replace(FIRST, duration_s=0.3)], tmp_path)
    assert here.ran == []
    outcomes = run_cases([FAILING, FAILING], tmp_path)
    assert here.ran == ["failing"]
    assert list(outcomes) == ["failing"]


def test_a_bad_case_is_refused_before_any_is_run(here: Here, tmp_path: Path) -> None:
    bad = Case("bad", "theorems.toml", 0.1, {"loop.rate_hz": -1})
    with pytest.raises(SessionFileError, match="rate_hz"):
        run_cases([FIRST, bad], tmp_path / "runs")
    assert here.ran == []
    assert not (tmp_path / "runs").exists()


def test_what_other_code_gave_is_refused(here: Here, tmp_path: Path) -> None:
    here.run = lambda case: run_case(replace(case, changes={"seed": 4}))
    with pytest.raises(RunnerError, match="second: the worker has other code"):
        run_cases([SECOND], tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_scheduler_that_does_not_answer_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "_ANSWERS_WITHIN", "500ms")
    with socket.socket() as held:  # bound, so that nobody else listens there
        held.bind(("127.0.0.1", 0))
        nobody = f"tcp://127.0.0.1:{held.getsockname()[1]}"
        for address in (nobody, "carrier://pigeon", "A.example"):
            with pytest.raises(RunnerError, match=f"no dask scheduler answers at {address}"):
                run_cases([FAILING], tmp_path, scheduler=address)


def test_without_the_extra_a_scheduler_is_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    little = Study("little", "Little", (FAILING,), lambda outcomes, folder: Section("", ""))
    monkeypatch.setattr("farhand.reproduce.STUDIES", (little,))
    arguments = ["reproduce", "little", "--out", str(tmp_path), "--scheduler", "tcp://x:1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "install the extra, farhand[cluster]" in " ".join(result.output.split())


# What goes wrong on the way


@pytest.mark.parametrize("where", ["processes", "cluster"])
def test_what_a_case_raises_reaches_the_caller_and_the_finished_are_kept(
    where: str, tmp_path: Path, request: pytest.FixtureRequest, expected: dict[str, bytes]
) -> None:
    scheduler = None
    if where == "cluster":
        scheduler = request.getfixturevalue("cluster").scheduler_address
    run_cases([FIRST], tmp_path, workers=1, scheduler=scheduler)
    # One process takes the longest first: SECOND is finished when RAISES begins.
    with pytest.raises(ZeroDivisionError):
        run_cases([FIRST, RAISES, SECOND], tmp_path, workers=1, scheduler=scheduler)
    assert kept(tmp_path)["first"] == expected["first"]
    assert "raises" not in kept(tmp_path)
    if where == "processes":
        assert kept(tmp_path)["second"] == expected["second"]


def interrupt(case: Case) -> None:
    raise KeyboardInterrupt


def test_interrupted_it_ends_its_processes_without_waiting_for_them(tmp_path: Path) -> None:
    others = set(active_children())
    with pytest.raises(KeyboardInterrupt):
        run_cases([ENDLESS, FIRST], tmp_path, workers=2, done=interrupt)
    assert set(kept(tmp_path)) == {"first"}
    assert set(active_children()) <= others


def test_ctrl_c_is_left_to_the_parent(tmp_path: Path, expected: dict[str, bytes]) -> None:
    others = set(active_children())

    def interrupt_workers(_: Case) -> None:
        for worker in set(active_children()) - others:
            os.kill(worker.pid, signal.SIGINT)

    longer = replace(FIRST, name="longer", duration_s=1.0)
    try:
        run_cases([longer, FIRST], tmp_path, workers=2, done=interrupt_workers)
    except KeyboardInterrupt:
        pytest.fail("a worker took it")
    assert kept(tmp_path)["first"] == expected["first"]
    assert set(kept(tmp_path)) == {"first", "longer"}


def test_interrupted_it_does_not_wait_for_a_cluster(cluster: LocalCluster, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_cases([ENDLESS, FIRST], tmp_path, scheduler=cluster.scheduler_address, done=interrupt)
    assert set(kept(tmp_path)) == {"first"}
    with Client(cluster) as client:
        client.restart()  # a worker cannot be told to leave a case


def test_workers_that_are_killed_are_told_of(tmp_path: Path) -> None:
    others = set(active_children())

    def kill() -> None:
        while not (workers := set(active_children()) - others):
            time.sleep(0.01)
        for worker in workers:
            worker.kill()

    killer = Thread(target=kill)
    killer.start()
    with pytest.raises(RunnerError, match="workers were lost"):
        run_cases([ENDLESS], tmp_path, workers=1)
    killer.join()


PROGRAM = f"""
import sys
import farhand.reproduce
from experiments.case import Case
from experiments.report import Section
from experiments.study import Study
from farhand.__main__ import main

FIRST = {FIRST!r}
SECOND = {SECOND!r}
ENDLESS = {ENDLESS!r}
section = lambda outcomes, folder: Section("Little", "Nothing.")
farhand.reproduce.STUDIES = (
    Study("finite", "", (FIRST, SECOND), section),
    Study("little", "", (FIRST, SECOND, ENDLESS), section),
)
if __name__ == "__main__":
    main()
"""


@pytest.mark.parametrize(
    ("how", "code"),
    [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)],
    ids=["Ctrl-C", "killed"],
)
def test_the_command_stopped_half_way_goes_on_from_there(
    how: signal.Signals, code: int, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    program, out = tmp_path / "program.py", tmp_path / "out"
    program.write_text(PROGRAM, encoding="utf-8")
    command = [sys.executable, str(program), "reproduce"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    started = subprocess.Popen(
        [*command, "little", "--out", str(out), "--workers", "2"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        seals = [out / "runs" / f"{name}.seal" for name in ("first", "second")]
        while not all(seal.exists() for seal in seals) and started.poll() is None:
            time.sleep(0.05)
        if how is signal.SIGINT:
            os.killpg(started.pid, how)  # as a terminal does
        else:
            started.send_signal(how)
        # It ends when nobody holds the pipes any more: the workers have gone, too.
        output, errors = started.communicate(timeout=60)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)
    assert started.returncode == code, errors
    assert "Traceback" not in output + errors
    if how is signal.SIGINT:
        assert "goes on with the runs that are missing" in " ".join(errors.split())
    assert not (out / "report.md").exists()
    before = stamps(out / "runs")
    assert {name: kept(out / "runs")[name] for name in ("first", "second")} == {
        name: expected[name] for name in ("first", "second")
    }
    assert "endless" not in kept(out / "runs")
    again = subprocess.run(
        [*command, "finite", "--out", str(out)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert again.returncode == 0, again.stderr
    assert stamps(out / "runs") == before
    assert (out / "report.md").exists()
    assert (out / "report.html").exists()
