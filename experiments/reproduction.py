"""The paper reproduced: studies run, their figures drawn, one report written."""

import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from math import isnan
from pathlib import Path

from experiments.case import Case, Outcome
from experiments.report import Section, Table, write_report
from experiments.runner import run_cases
from experiments.study import Outcomes, Study

_INTRODUCTION = """\
*Controlled synchronization of nonlinear teleoperation in task-space with time-varying delays*
(Zakerimanesh, Hashemzadeh, Torabi, Tavakoli), its figures, theorems and remarks, on the code that
farhand's daemons run, on a clock turned by hand. Every number and figure is written by

```
farhand reproduce {names}
```

with farhand {farhand}, Python {python}, numpy {numpy} and pin {pin}; other versions may differ in
the last digits. A verdict is computed from the numbers beside it, never typed in."""
_INVARIANTS = (
    *("run", "time [s]", "TTE [m]", "T measured / certified [s]", "max ‖Jζ‖ [m/s]"),
    *("‖STE‖ at the end [rad/s]", "max ‖ΩP‖∞ [N]", "rise of V / V(0)"),
)


def reproduce(
    studies: Sequence[Study],
    folder: Path,
    *,
    command: str,
    workers: int | None = None,
    scheduler: str | None = None,
    done: Callable[[Case], None] = lambda case: None,
) -> None:
    """Run the studies' cases and write report.md, report.html and figures into `folder`.

    Runs are kept in its sub-folder runs/, and only those are run that are not there yet.
    """
    cases = [case for study in studies for case in study.cases]
    outcomes = run_cases(cases, folder / "runs", workers=workers, scheduler=scheduler, done=done)
    sections = [study.section(outcomes, folder) for study in studies]
    introduction = _INTRODUCTION.format(
        names=command,
        python=platform.python_version(),
        **{name: version(name) for name in ("farhand", "numpy", "pin")},
    )
    write_report(folder, "The paper, reproduced", introduction, [*sections, _invariants(outcomes)])


def _invariants(outcomes: Outcomes) -> Section:
    """Tell what can be compared whatever the pose: one row a run."""
    return Section(
        "Invariants",
        "What can be compared without the paper's trajectories, for every run of the report, from "
        "every tick of it. TTE is ‖X_l − X_r‖; T the greatest measured age of the whole loop; "
        "‖Jζ‖ is zero by construction, so what is left is rounding; V is the corrected functional, "
        "where it was evaluated, and its rise counts from its least value before.",
        tables=(
            Table(
                "",
                _INVARIANTS,
                tuple(_invariant_row(outcome) for outcome in outcomes.values()),
            ),
        ),
    )


def _invariant_row(outcome: Outcome) -> tuple[str, ...]:
    m = outcome.measures
    ended = " (failed)" if outcome.failures else ""
    if not m:  # it failed in its first tick
        return (f"{outcome.case.name}{ended}", *[""] * (len(_INVARIANTS) - 1))
    force_n = max(m["local_coupling_force_max_n"], m["remote_coupling_force_max_n"])
    rise = m["energy_rise_j"] / m["energy_start_j"] if m.get("energy_start_j") else None
    trip = "–" if isnan(m["round_trip_max_s"]) else f"{m['round_trip_max_s']:.3f}"
    return (
        f"{outcome.case.name}{ended}",
        f"{m['duration_s']:.1f}",
        f"{m['error_start_m']:.3f} → {m['error_end_m']:.1e}",
        f"{trip} / {m['certified_round_trip_s']:.3f}",
        f"{m['null_space_leak_m_s']:.0e}",
        f"{m['sub_task_error_end_rad_s']:.0e}",
        f"{force_n:.2f}",
        "" if rise is None else f"{rise:.0e}",
    )
