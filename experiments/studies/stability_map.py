"""What each certificate allows over stiffness and round trip, and what simulation shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from experiments.case import Case, Outcome
from experiments.plots import MapPoint, map_figure
from experiments.report import Claim, Figure, Section, Table, Verdict
from experiments.study import Outcomes, Study, both_ways
from site_runtime.certification import Certification, certify
from site_runtime.session_edit import TomlValue

_STIFF = (5, 20, 50, 100, 200, 400, 800)
_ROUND_TRIP_S = (0.05, 0.2, 0.5, 1.0, 2.0, 4.0)
_NOT_FALLING = 0.8  # the last quarter's largest error, as a share of the second's


@dataclass(frozen=True, slots=True)
class _Map:
    """One pair of arms under one damping: points (K, T), each a case."""

    name: str
    title: str
    session_file: str
    stiffness_n_per_m: tuple[int, ...]
    duration_s: float
    axes: int
    changes: Mapping[str, TomlValue | None]

    def case(self, stiffness_n_per_m: int, round_trip_s: float) -> Case:
        delay: TomlValue = {"model": "constant", "delay_s": 0.5 * round_trip_s}
        return Case(
            f"map_{self.name}_{stiffness_n_per_m}_{round_trip_s:g}",
            self.session_file,
            self.duration_s,
            {
                **self.changes,
                "coupling.stiffness_n_per_m": [float(stiffness_n_per_m)] * self.axes,
                **both_ways("delay", delay),
            },
            trace_hz=10,
            until_settled=True,
        )

    def cases(self) -> tuple[Case, ...]:
        return tuple(self.case(K, T) for K in self.stiffness_n_per_m for T in _ROUND_TRIP_S)


_MAPS = (
    _Map(
        "joint",
        "2R and 3R, the paper's joint damping",
        "theorems.toml",
        (1, 2, 5, 10, 20, 50, 100),
        15.0,
        2,
        {
            "local.damping": {"joint_nm_s": [0.94, 0.94], "task_n_s_per_m": [0.0, 0.0]},
            "remote.damping": {"joint_nm_s": [3.19, 3.2, 3.21], "task_n_s_per_m": [0.0, 0.0]},
        },
    ),
    _Map("task", "2R and 3R, task damping 15.1 N·s/m", "theorems.toml", _STIFF, 10.0, 2, {}),
    _Map(
        "seven",
        "7R and 7R, task damping 30 N·s/m",
        "seven_dof.toml",
        _STIFF,
        16.0,
        3,
        {
            "local.operator": None,
            "remote.environment": None,
            "engagement.beyond_certificate": "warn",
            **both_ways("loss", None),
        },
    ),
)


def _verdict(outcome: Outcome) -> str:
    m = outcome.measures
    if outcome.failures or not m:
        return "diverged"
    if m["settled_1_mm_s"] < m["duration_s"]:
        return "converged"
    if m["error_last_quarter_m"] >= _NOT_FALLING * m["error_second_quarter_m"]:
        return "diverged"
    return "slow"


def _section(outcomes: Outcomes, folder: Path) -> Section:
    certifications = {case.name: certify(case.session()) for each in _MAPS for case in each.cases()}
    points = {each.name: _points(each, outcomes, certifications) for each in _MAPS}
    limits = {each.name: _limits(each, certifications) for each in _MAPS}
    map_figure(
        folder / "map.png",
        [(each.title, points[each.name], limits[each.name]) for each in _MAPS],
    )
    everywhere = [point for of_map in points.values() for point in of_map]
    certified = [point for point in everywhere if point.certified]
    uncertified = [point for point in everywhere if not point.certified]
    by_17 = [
        certification
        for certification in certifications.values()
        if certification.certificates[0].round_trip_s > certification.injected_round_trip_s
    ]
    also_by_a = [
        certification
        for certification in by_17
        if certification.certificates[1].round_trip_s > certification.injected_round_trip_s
    ]
    return Section(
        "Certificates over stiffness and round trip",
        "Free motion under constant delay, half of T each way: for the paper's pair under its own "
        "joint damping and under task damping, and for two arms of seven joints from a URDF. "
        "*Converged*: within a millimetre in the time simulated; *slow*: not yet, but falling; "
        "*diverged*: a fault, or an error whose largest value in the last quarter of the time is "
        f"not below {_NOT_FALLING:.0%} of that in the second. Curves are what each theorem "
        "certifies, a tick of hold included. A certificate is sufficient: much beyond it is stable "
        "all the same.",
        (
            Claim(
                "docs/theory.md, Theorems A and B",
                "no certified point diverges",
                f"of {len(certified)} certified points {_count(certified, 'converged')} converged, "
                f"{_count(certified, 'slow')} are slow, {_count(certified, 'diverged')} diverged; "
                f"of {len(uncertified)} others {_count(uncertified, 'diverged')} diverged",
                Verdict.of(_count(certified, "diverged") == 0),
            ),
            Claim(
                "docs/theory.md, Corollary A",
                "what (17) certifies, Theorem A certifies",
                f"{len(also_by_a)} of {len(by_17)} points",
                Verdict.of(0 < len(by_17) == len(also_by_a)),
            ),
        ),
        tuple(_table(each, points[each.name]) for each in _MAPS),
        (Figure("map.png", "What is certified, and what simulation shows"),),
    )


def _points(
    each: _Map, outcomes: Outcomes, certifications: Mapping[str, Certification]
) -> list[MapPoint]:
    points = []
    for K in each.stiffness_n_per_m:
        for T in _ROUND_TRIP_S:
            name = each.case(K, T).name
            certification = certifications[name]
            points.append(
                MapPoint(
                    float(K),
                    certification.injected_round_trip_s,
                    _verdict(outcomes[name]),
                    certified=certification.margin_s > 0.0,
                )
            )
    return points


def _limits(
    each: _Map, certifications: Mapping[str, Certification]
) -> dict[str, list[tuple[float, float]]]:
    """Certified round trip over stiffness, by theorem, where there is one."""
    limits: dict[str, list[tuple[float, float]]] = {}
    for K in each.stiffness_n_per_m:
        for certificate in certifications[each.case(K, _ROUND_TRIP_S[0]).name].certificates:
            if certificate.round_trip_s > 0.0:
                limits.setdefault(certificate.theorem, []).append(
                    (float(K), certificate.round_trip_s)
                )
    return limits


def _count(points: list[MapPoint], verdict: str) -> int:
    return sum(point.verdict == verdict for point in points)


def _table(each: _Map, points: list[MapPoint]) -> Table:
    """Rows of T, columns of K; certified points are bold."""
    cells = [f"**{point.verdict}**" if point.certified else point.verdict for point in points]
    width = len(_ROUND_TRIP_S)
    return Table(
        f"{each.title} (bold: certified):",
        ("T [s] \\ K [N/m]", *(str(K) for K in each.stiffness_n_per_m)),
        tuple((f"{T:g}", *cells[row::width]) for row, T in enumerate(_ROUND_TRIP_S)),
    )


STUDY = Study(
    "map",
    "Certificates over stiffness and round trip",
    tuple(case for each in _MAPS for case in each.cases()),
    _section,
)
