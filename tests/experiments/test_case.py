"""One run: what decides its bits, what is kept of it, when it ends."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import case as case_module
from experiments.case import SETTLED_M, Case, Outcome, read_outcome, run_case
from experiments.measures import measure
from experiments.simulation import Simulation
from site_runtime.derived import derivation
from site_runtime.session import SessionError, SessionFileError
from telemetry.rows import TelemetryError

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENTS = ROOT / "experiments"
BASE = Case("base", "theorems.toml", 0.3)


@pytest.fixture
def copied_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the code, which fingerprints are then made of."""
    for package in ROOT.glob("*/__init__.py"):
        shutil.copytree(package.parent, tmp_path / package.parent.name)
    case_module._source_digest.cache_clear()
    monkeypatch.setattr(case_module, "EXPERIMENTS", tmp_path / "experiments")
    yield tmp_path
    case_module._source_digest.cache_clear()


def outcome(case: Case, tmp_path: Path) -> Outcome:
    file = tmp_path / f"{case.name}.parquet"
    file.write_bytes(run_case(case))
    return read_outcome(case, file)


def test_changes_reach_the_session_and_leave_the_rest() -> None:
    delay = {"model": "constant", "delay_s": 0.05}
    changed = replace(
        BASE,
        changes={
            "coupling.stiffness_n_per_m": [40.0, 45.0],
            "channel.local_to_remote.delay": delay,
            "remote.sub_tasks": None,
        },
    ).session()
    base = BASE.session()
    assert changed.coupling.stiffness_n_per_m == (40.0, 45.0)  # type: ignore[union-attr]
    assert changed.channel.local_to_remote.delay.delay_s == 0.05  # type: ignore[union-attr]
    assert base.remote.sub_tasks
    assert changed.remote.sub_tasks == ()
    assert (changed.loop, changed.local) == (base.loop, base.local)
    assert changed.channel.remote_to_local == base.channel.remote_to_local


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"remote.no_such_key": 1.0}, SessionFileError, "remote.no_such_key"),
        ({"loop.rate_hz": -1}, SessionFileError, "loop.rate_hz"),
        ({"coupling.stiffness_n_per_m": [50.0]}, SessionFileError, "stiffness_n_per_m"),
        ({"remote.sub_tasks[7].gain": 1.0}, SessionError, "a list of 1"),
        ({"not a key": 1.0}, SessionError, "is not a key"),
    ],
)
def test_a_bad_change_is_refused_before_it_runs(
    changes: dict[str, Any],
    error: type[SessionError],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Simulation, "run", lambda *_: pytest.fail("it was run"))
    bad = replace(BASE, changes=changes)
    for use in (bad.session, bad.fingerprint, lambda: run_case(bad)):
        with pytest.raises(error, match=words.replace("[", r"\[")):
            use()


def test_the_fingerprint_is_that_of_all_that_decides_the_bits() -> None:
    variants = [
        BASE,
        replace(BASE, duration_s=0.31),
        replace(BASE, trace_hz=100),
        replace(BASE, until_settled=True),
        replace(BASE, energy_window_s=(0.2, 0.2)),
        replace(BASE, energy_window_s=(0.2, 0.3)),
        replace(BASE, changes={"seed": 2}),
        replace(BASE, changes={"remote.sub_tasks": None}),
        replace(BASE, session_file="theorem_b.toml"),
    ]
    fingerprints = [case.fingerprint() for case in variants]
    assert len(set(fingerprints)) == len(variants)
    assert fingerprints == [case.fingerprint() for case in variants]
    assert replace(BASE, name="other").fingerprint() == fingerprints[0]


def test_comments_in_the_session_file_leave_the_fingerprint(tmp_path: Path) -> None:
    text = (EXPERIMENTS / BASE.session_file).read_text(encoding="utf-8")
    file = tmp_path / "session.toml"
    case = replace(BASE, session_file=str(file))
    file.write_text("# in other words\n" + text, encoding="utf-8")
    assert case.fingerprint() == BASE.fingerprint()
    file.write_text(text.replace("seed = 1", "seed = 2"), encoding="utf-8")
    assert case.fingerprint() != BASE.fingerprint()


def test_the_content_of_a_urdf_file_counts_not_its_place(tmp_path: Path) -> None:
    urdf = (EXPERIMENTS / "seven_dof_arm.urdf").read_text(encoding="utf-8")
    shutil.copy(EXPERIMENTS / "seven_dof.toml", tmp_path)
    (tmp_path / "seven_dof_arm.urdf").write_text(urdf, encoding="utf-8")
    shipped = Case("seven", "seven_dof.toml", 0.1)
    copied = replace(shipped, session_file=str(tmp_path / "seven_dof.toml"))
    assert copied.fingerprint() == shipped.fingerprint()
    heavier = urdf.replace('<mass value="', '<mass value="1', 1)
    assert heavier != urdf
    (tmp_path / "seven_dof_arm.urdf").write_text(heavier, encoding="utf-8")
    assert copied.fingerprint() != shipped.fingerprint()


def test_the_libraries_count(monkeypatch: pytest.MonkeyPatch) -> None:
    fingerprints = set()
    for newer in ("none", "numpy", "pin"):
        monkeypatch.setattr(case_module, "version", lambda name, n=newer: str(name == n))
        fingerprints.add(BASE.fingerprint())
    assert len(fingerprints) == 3


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("control_law/null_space.py", True),
        ("remote_site/controller.py", True),
        ("experiments/simulation.py", True),
        ("experiments/measures.py", True),
        ("experiments/report.py", False),
        ("experiments/studies/figure_5.py", False),
    ],
)
def test_the_code_of_a_run_counts_a_study_s_words_do_not(
    copied_sources: Path, file: str, counts: bool
) -> None:
    before = BASE.fingerprint()
    case_module._source_digest.cache_clear()
    assert BASE.fingerprint() == before
    with (copied_sources / file).open("a", encoding="utf-8") as source:
        source.write("SOMETHING = 1\n")
    case_module._source_digest.cache_clear()
    assert (BASE.fingerprint() != before) == counts


def test_all_code_that_a_run_loads_counts() -> None:
    run = (
        "import sys; from experiments.case import Case, run_case; "
        "run_case(Case('a', 'demo.toml', 0.05, energy_window_s=(0.2, 0.2))); "
        "print(*(m.__file__ for m in sys.modules.values() if getattr(m, '__file__', None)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", run], cwd=ROOT, capture_output=True, text=True, check=True
    )
    packages = [file.parent for file in ROOT.glob("*/__init__.py")]
    loaded = map(Path, done.stdout.split())
    own = [file for file in loaded if any(file.is_relative_to(package) for package in packages)]
    assert len(own) > 30
    sources = [ROOT / source for source in case_module._SOURCES]
    for file in own:
        counts = any(file.is_relative_to(source) for source in sources)
        assert counts or file == EXPERIMENTS / "__init__.py", file


def test_a_case_gives_the_same_bytes_each_time(tmp_path: Path) -> None:
    # Random losses and delays, obstacles, and the energy: all that could differ.
    case = Case(
        "twice",
        "demo.toml",
        0.2,
        {"channel.local_to_remote.loss": {"enter_burst": 0.1, "leave_burst": 0.3}},
        energy_window_s=(0.2, 0.2),
    )
    assert run_case(case) == run_case(case)
    assert run_case(replace(case, changes={**case.changes, "seed": 2})) != run_case(case)


def test_an_outcome_reads_back_as_it_was(short: Outcome) -> None:
    case = short.case
    session = case.session()
    run = Simulation(session).run(case.duration_s)
    rows = slice(None, None, session.loop.rate_hz // case.trace_hz)
    assert short.failures == ()
    assert short.time_s == pytest.approx(np.arange(21) / 50.0)
    assert np.array_equal(short.vector("remote_q"), run.remote["q"][rows])
    assert np.array_equal(short.vector("local_position"), run.local["position_m"][rows])
    for site, q in (("local", run.local["q"][rows]), ("remote", run.remote["q"][rows])):
        for name, values in derivation(session)(site, q).items():
            assert np.array_equal(short.scalar(f"{site}_{name}"), values, equal_nan=True)
    assert np.array_equal(
        short.error_m(), run.local["position_m"][rows] - run.remote["position_m"][rows]
    )
    assert short.distance_m() == pytest.approx(np.hypot(*short.error_m().T))
    assert short.energy_j.shape == short.time_s.shape
    assert short.energy_j[0] == short.measures["energy_start_j"]
    again = measure(session, run, np.empty(0))
    for name, value in again.items():
        np.testing.assert_equal(short.measures[name], value)
    assert short.trace.metadata["session"] == session.text
    assert short.trace.metadata["fingerprint"] == case.fingerprint()


def test_without_a_window_there_is_no_energy(tmp_path: Path) -> None:
    plain = outcome(replace(BASE, duration_s=0.1), tmp_path)
    assert plain.energy_j.shape == (0,)
    assert not any(name.startswith("energy") for name in plain.measures)


def test_what_is_no_result_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "no.parquet"
    file.write_bytes(b"nothing of the kind")
    with pytest.raises(TelemetryError, match=r"no\.parquet"):
        read_outcome(BASE, file)


def test_a_failure_is_kept_with_what_was_before_it(tmp_path: Path) -> None:
    unstable = {"remote.damping.task_n_s_per_m": [2e4, 2e4], "remote.sub_tasks": None}
    failed = outcome(replace(BASE, changes=unstable, duration_s=1.0), tmp_path)
    (failure,) = failed.failures
    assert failure.startswith("remote: ")
    assert 0.0 < failed.measures["duration_s"] < 1.0
    assert len(failed.time_s) == 1 + int(failed.measures["duration_s"] * 50 + 1e-6)


def test_a_failure_at_time_zero_is_an_outcome_without_rows(failed_at_once: Outcome) -> None:
    (failure,) = failed_at_once.failures
    assert failure.startswith("remote: ZeroDivisionError")
    assert failed_at_once.measures == {}
    assert failed_at_once.time_s.shape == failed_at_once.energy_j.shape == (0,)
    assert failed_at_once.vector("remote_q").shape == (0, 3)


def aligned(changes: dict[str, Any], duration_s: float, *, until_settled: bool) -> Case:
    """Both arms alike and at rest in one pose."""
    site = BASE.session().local
    alike = {
        "remote.robot": {"kind": "planar", "lengths_m": [0.38, 0.38], "masses_kg": [0.3, 0.3]},
        "remote.damping.joint_nm_s": [0.05, 0.05],
        "remote.device.initial_position_rad": list(site.device.initial_position_rad),
        "remote.sub_tasks": None,
    }
    return replace(
        BASE, changes={**alike, **changes}, duration_s=duration_s, until_settled=until_settled
    )


def test_a_settled_run_ends_after_a_whole_second(tmp_path: Path) -> None:
    settled = outcome(aligned({}, 3.0, until_settled=True), tmp_path)
    # It is looked at every tenth of a second.
    assert 1.0 <= settled.measures["duration_s"] <= 1.1
    assert settled.measures["error_max_m"] < SETTLED_M
    whole = outcome(aligned({}, 1.5, until_settled=False), tmp_path)
    assert whole.measures["duration_s"] == pytest.approx(1.5)


def test_a_run_that_was_apart_ends_a_whole_second_after_it(tmp_path: Path) -> None:
    push = {"axis": "x", "force_n": 3.0, "start_s": 0.2, "end_s": 0.6}
    changes = {"local.operator": {"kind": "pulses", "pulses": [push]}}
    case = aligned(changes, 6.0, until_settled=True)
    pushed = outcome(replace(case, trace_hz=1000), tmp_path)
    apart_s = pushed.time_s[pushed.distance_m() >= SETTLED_M]
    assert apart_s[0] > 0.2
    assert 1.0 <= pushed.measures["duration_s"] - apart_s[-1] <= 1.1
    assert pushed.measures["duration_s"] > 2.0
