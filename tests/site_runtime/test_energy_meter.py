"""The meter by identities: V falls in free certified motion, and the powers balance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from experiments.measures import energy_trace_j
from experiments.simulation import Run, Simulation
from farhand.picture import picture_of
from site_runtime.energy_meter import (
    FunctionalRules,
    SessionEnergyMeter,
    functional_rules,
)
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of, robot_of
from site_runtime.session import Session, load_session
from site_runtime.supervisor import State
from telemetry.energy import EnergyMeter, EnergyTrace

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
FloatArray = npt.NDArray[np.float64]

Played = tuple[Session, Run]


def played(name: str, seconds: float) -> Played:
    session = load_session(EXPERIMENTS / f"{name}.toml")
    return session, Simulation(session).run(seconds)


@pytest.fixture(scope="module")
def free() -> Played:
    """Free motion with task damping and a sub-task, certified."""
    return played("theorem_b", 3.0)


@pytest.fixture(scope="module")
def pushed() -> Played:
    """A hand that pushes, a wall, a sub-task that is limited and ramps in."""
    return played("demo", 4.0)


def meter_of(session: Session) -> EnergyMeter:
    make = picture_of(session).meter
    assert make is not None
    return make()


def measured(meter: EnergyMeter, run: Run, piece: int = 10**9) -> EnergyTrace:
    traces = []
    for start in range(0, len(run.local), piece):
        part = slice(start, start + piece)
        times_ns = run.local["time_ns"][part].astype(np.int64)
        traces.append(meter.update(times_ns, run.local[part], run.remote[part]))
    return EnergyTrace(
        np.concatenate([trace.times_ns for trace in traces]),
        np.concatenate([trace.functional_j for trace in traces]),
        np.concatenate([trace.injected_j for trace in traces]),
        np.concatenate([trace.dissipated_j for trace in traces]),
    )


def indices(run: Run, trace: EnergyTrace) -> npt.NDArray[np.intp]:
    return np.searchsorted(run.local["time_ns"], trace.times_ns)


def test_the_energy_of_the_proof_never_rises_in_free_certified_motion(free: Played) -> None:
    session, run = free
    trace = measured(meter_of(session), run)
    total_j = trace.functional_j.sum(axis=1)
    assert np.isfinite(total_j).all()
    assert (np.diff(trace.times_ns) == 10_000_000).all()
    assert np.diff(total_j).max() <= 0.0
    assert total_j[-1] < 0.02 * total_j[0]


def test_decimated_it_is_the_energy_of_every_tick(free: Played, pushed: Played) -> None:
    for session, run in (free, pushed):
        rules = functional_rules(session)
        trace = measured(meter_of(session), run)
        every_tick_j = energy_trace_j(session, run, (rules.window_local_s, rules.window_remote_s))
        total_j = trace.functional_j.sum(axis=1)
        whole = np.isfinite(total_j)
        assert whole[-1]
        expected_j = every_tick_j[indices(run, trace)][whole]
        # only the transit integral, by the trapezoidal rule, knows of the longer steps
        assert total_j[whole] == pytest.approx(expected_j, abs=1e-3 * expected_j.max())


@pytest.mark.parametrize("name", ["free", "pushed"])
def test_what_is_put_in_is_dissipated_or_moves(name: str, request: pytest.FixtureRequest) -> None:
    session, run = request.getfixturevalue(name)
    trace = measured(meter_of(session), run)
    kinetic_j = trace.functional_j[:, 0]
    coupling_j = sum(work_of_coupling_j(rows) for rows in (run.local, run.remote))
    balance_j = (
        (trace.injected_j - trace.dissipated_j).sum(axis=1)
        + coupling_j[indices(run, trace)]
        - kinetic_j
    )
    whole = np.isfinite(kinetic_j)
    error_j = np.abs(balance_j[whole] - balance_j[whole][0]).max()
    # The simulated arm is stepped to first order: a tick's held torque does ½Δq̇ᵀMΔq̇ more than
    # its power at the ends says.
    assert error_j <= held_j(session, run)
    assert error_j < 0.02 * np.ptp(coupling_j)
    assert trace.dissipated_j[-1].min() > 0.1


def work_of_coupling_j(rows: npt.NDArray[np.void]) -> FloatArray:
    power_w = np.einsum("kz,kz->k", rows["coupling_force_n"], rows["velocity_m_s"])
    return np.concatenate(([0.0], np.cumsum(0.5e-3 * (power_w[1:] + power_w[:-1]))))


def held_j(session: Session, run: Run) -> float:
    total = 0.0
    for site, rows in zip(SiteId, (run.local, run.remote), strict=True):
        robot = robot_of(session, site)
        for row, step in zip(rows, np.diff(rows["q_dot"], axis=0), strict=False):
            total += 0.5 * float(step @ robot.terms(row["q"], row["q_dot"]).M @ step)
    return total


def test_rows_in_pieces_tell_the_same(pushed: Played) -> None:
    session, run = pushed
    at_once = measured(meter_of(session), run)
    in_pieces = measured(meter_of(session), run, piece=37)
    assert np.array_equal(at_once.times_ns, in_pieces.times_ns)
    for name in ("functional_j", "injected_j", "dissipated_j"):
        expected, got = getattr(at_once, name), getattr(in_pieces, name)
        assert got == pytest.approx(expected, rel=1e-3, abs=1e-4, nan_ok=True), name


def test_v_is_silent_where_the_proof_is(pushed: Played) -> None:
    session, run = pushed
    local, remote = run.local.copy(), run.remote.copy()
    local["force_share"][3000:3100] = 0.9
    remote["state"][3200:3300] = State.HOLD
    trace = measured(meter_of(session), Run(local, remote, ()))
    silent = np.isnan(trace.functional_j).all(axis=1)
    assert silent[:90].all()  # the gains ramp in
    assert np.flatnonzero(silent[110:]).tolist() == [*range(190, 200), *range(210, 220)]


def test_a_stopped_site_puts_nothing_in(pushed: Played) -> None:
    session, run = pushed
    whole = measured(meter_of(session), run)
    local = run.local.copy()
    local["state"][2000:] = State.FAULT
    local["engaged_s"][2000:] = np.nan
    stopped = measured(meter_of(session), Run(local, run.remote, ()))
    for work, expected in (
        (stopped.injected_j, whole.injected_j),
        (stopped.dissipated_j, whole.dissipated_j),
    ):
        assert work[:200] == pytest.approx(expected[:200])
        assert np.ptp(work[202:, 0]) == 0.0
    assert np.ptp(stopped.dissipated_j[202:, 1]) > 0.1


def test_after_a_gap_it_goes_on_without_what_it_missed(pushed: Played) -> None:
    session, run = pushed
    meter = meter_of(session)
    pieces = [slice(0, 2000), slice(3000, 4001)]
    traces = [
        meter.update(run.local["time_ns"][p].astype(np.int64), run.local[p], run.remote[p])
        for p in pieces
    ]
    assert traces[1].injected_j[0] == pytest.approx(traces[0].injected_j[-1], abs=0.1)
    assert traces[1].functional_j[0, 2] == 0.0  # nothing is known to be in transit


def test_the_windows_share_the_certified_round_trip() -> None:
    session = load_session(EXPERIMENTS / "demo.toml")
    rules = functional_rules(session)
    assert rules.window_local_s + rules.window_remote_s == pytest.approx(0.298)
    slow = replace(
        session.channel.local_to_remote.delay, mean_s=0.08
    )  # 0.11 s at most, 0.03 s more than back
    channel = replace(
        session.channel, local_to_remote=replace(session.channel.local_to_remote, delay=slow)
    )
    rules = functional_rules(replace(session, channel=channel))
    assert rules.window_local_s + rules.window_remote_s == pytest.approx(0.298)
    assert rules.window_local_s - rules.window_remote_s == pytest.approx(0.03)


def test_unequal_damping_is_weighed_so_that_both_sites_have_enough() -> None:
    session = load_session(EXPERIMENTS / "demo.toml")
    strong = replace(session.local.damping, task_n_s_per_m=(60.0, 60.0))
    rules = functional_rules(replace(session, local=replace(session.local, damping=strong)))
    trip_s = rules.window_local_s + rules.window_remote_s
    hold_s = session.period_ns * 1e-9
    # c_l = α T/2 and c_r = T/(2α) stay below D/K, the hold of a tick taken off
    for damping, factor in ((60.0, rules.alpha), (30.0, 1 / rules.alpha)):
        assert factor * trip_s / 2 == pytest.approx(damping / 200.0 - hold_s, rel=1e-6)


def test_v_with_windows_beyond_the_certificate_rises(free: Played) -> None:
    session, run = free
    meter = SessionEnergyMeter(
        coupling_of(session.coupling),
        FunctionalRules(5.0, 5.0, 1.0),
        (robot_of(session, SiteId.LOCAL), robot_of(session, SiteId.REMOTE)),
        (damping_of(session.local.damping), damping_of(session.remote.damping)),
        None,
    )
    assert np.diff(measured(meter, run).functional_j.sum(axis=1)).max() > 1e-3
