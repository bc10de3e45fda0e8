"""One run of a study: a session file with some keys changed, simulated, measured and kept."""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiments.measures import Measures, energy_trace_j, measure
from experiments.simulation import Run, Simulation
from site_runtime.derived import derivation
from site_runtime.session import Session, parse_session
from site_runtime.session_edit import TomlValue, edited
from telemetry.result_file import Result, read_result, write_result

EXPERIMENTS = Path(__file__).resolve().parent
SETTLED_M = 1e-3
FloatArray = npt.NDArray[np.float64]
_OF_VECTOR = re.compile(r"_([xyz]|\d+)$")
_SETTLED_FOR_S = 1.0
# What a run goes through: neither how studies are told nor how they are drawn
_SOURCES = (
    *("channel", "control_law", "hardware", "local_site", "remote_site", "site_runtime"),
    *("telemetry", "experiments/case.py", "experiments/measures.py", "experiments/simulation.py"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """A session file, relative to experiments/, the keys changed in it, and how long it runs.

    `name` names the case in its study. With `until_settled` the run ends once the sites have been
    within a millimetre of each other for a second; with `energy_window_s`, (d̄_l, d̄_r), the
    Lyapunov–Krasovskii functional is evaluated at every tick over these windows.
    """

    name: str
    session_file: str
    duration_s: float
    changes: Mapping[str, TomlValue | None] = field(default_factory=dict)
    trace_hz: int = 50
    until_settled: bool = False
    energy_window_s: tuple[float, float] | None = None

    def session(self) -> Session:
        """Load the session; raises SessionFileError if the changes contradict it."""
        path = EXPERIMENTS / self.session_file
        return parse_session(edited(path.read_text(encoding="utf-8"), self.changes), path)

    def fingerprint(self) -> str:
        """Digest of all that decides the run's bits: session, duration, code, libraries."""
        session = self.session()
        decisive = (
            *(session.digest, self.duration_s, self.trace_hz, self.until_settled),
            *(self.energy_window_s, _source_digest(), version("numpy"), version("pin")),
        )
        return hashlib.blake2b(repr(decisive).encode(), digest_size=16).hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What is kept of a case: figures from every tick, and rows `trace_hz` times a second.

    `energy_j` is V at those rows, (r,), or (0,) where it was not evaluated.
    """

    case: Case
    measures: Measures
    trace: Result
    energy_j: FloatArray
    failures: tuple[str, ...]

    @property
    def time_s(self) -> FloatArray:
        """Session time of the rows kept [s], (r,)."""
        return self.trace.time_s

    def scalar(self, column: str) -> FloatArray:
        """Return a column of the result file, (r,), e.g. `remote_manipulability`."""
        return np.asarray(self.trace.columns[column], dtype=np.float64)

    def vector(self, column: str) -> FloatArray:
        """Return a vector's columns side by side, (r, n), e.g. `local_position`, `remote_q`."""
        names = [name for name in self.trace.columns if _OF_VECTOR.sub("", name) == column]
        return np.column_stack([self.scalar(name) for name in names])

    def error_m(self) -> FloatArray:
        """Return TTE = X_l − X_r [m], (r, z)."""
        return self.vector("local_position") - self.vector("remote_position")

    def distance_m(self) -> FloatArray:
        """Return ‖TTE‖ [m], (r,)."""
        distance_m: FloatArray = np.linalg.norm(self.error_m(), axis=1)
        return distance_m


def run_case(case: Case) -> bytes:
    """Simulate a case; return its outcome as the bytes of a result file, the same every time."""
    session = case.session()
    simulation = Simulation(session)
    run = simulation.run(
        case.duration_s, until=_settled(simulation) if case.until_settled else None
    )
    energy_j = energy_trace_j(session, run, case.energy_window_s)
    every = max(1, session.loop.rate_hz // case.trace_hz)
    file = BytesIO()
    write_result(
        file,
        run.local[::every],
        run.remote[::every],
        {
            "session": session.text,
            "fingerprint": case.fingerprint(),
            "measures": json.dumps(measure(session, run, energy_j)),
            "energy_j": json.dumps(energy_j[::every].tolist()),
            "failures": json.dumps(run.failures),
        },
        derivation(session),
    )
    return file.getvalue()


def read_outcome(case: Case, file: Path) -> Outcome:
    """Read what `run_case` gave; TelemetryError if it is no result file."""
    trace = read_result(file)
    kept = {key: json.loads(trace.metadata[key]) for key in ("measures", "energy_j", "failures")}
    return Outcome(
        case, kept["measures"], trace, np.array(kept["energy_j"]), tuple(kept["failures"])
    )


def _settled(simulation: Simulation) -> Callable[[Run], bool]:
    """Whether the newest second of both sites' rows is within a millimetre."""

    def ended(recent: Run) -> bool:
        if len(recent.local) < _SETTLED_FOR_S * 1e9 / simulation.period_ns:
            return False
        apart_m = np.linalg.norm(recent.local["position_m"] - recent.remote["position_m"], axis=1)
        return bool(apart_m.max() < SETTLED_M)

    return ended


@cache
def _source_digest() -> str:
    """Digest of the code that a run goes through."""
    digest = hashlib.blake2b(digest_size=16)
    for source in _SOURCES:
        path = EXPERIMENTS.parent / source
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()
