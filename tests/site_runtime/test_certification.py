from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from control_law import sampling
from site_runtime.certification import (
    Bound,
    DampingLimit,
    SamplingRatio,
    certify,
    damping_limit,
    sampling_ratio,
)
from site_runtime.keys import SiteId
from site_runtime.session import ChannelSettings, DampingSettings, Session, load_session

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
PERIOD_S = 1e-3


@pytest.fixture(scope="module")
def paper() -> Session:
    return load_session(EXPERIMENTS / "paper_free.toml")


@pytest.fixture(scope="module")
def theorem_b() -> Session:
    return load_session(EXPERIMENTS / "theorem_b.toml")


def test_the_papers_gains_are_certified_by_its_own_condition_and_better_by_theorem_a(
    paper: Session,
) -> None:
    result = certify(paper)
    condition, theorem_a, theorem_b = result.certificates
    # (17) with the square of the reach for J_max²: 0.76² and 1.14² m²
    local_s, remote_s = 0.94 / (2 * 2 * 0.5776), 3.19 / (2 * 3 * 1.2996)
    assert condition.round_trip_s == pytest.approx(min(local_s, remote_s) - 2 * PERIOD_S)
    assert condition.round_trip_s > 0.4
    # straight arms: λ_max(JᵀJ) = 5 L² and 14 L²
    reach2 = 0.38**2 * np.array([9.0, 4.0, 1.0])
    mu_l, mu_r = reach2[1:].sum() / 0.94, (reach2 / [3.19, 3.20, 3.21]).sum()
    expected_s = 2 * np.sqrt((1 / mu_l - PERIOD_S) * (1 / mu_r - PERIOD_S))
    assert theorem_a.round_trip_s == pytest.approx(expected_s)
    assert theorem_a.round_trip_s == pytest.approx(2.87, abs=0.005)
    assert theorem_b.round_trip_s == 0.0
    assert result.best == theorem_a


def test_the_session_injects_both_bounds_packet_spacing_and_a_tick_a_side(paper: Session) -> None:
    result = certify(paper)
    assert result.injected_round_trip_s == pytest.approx(0.2 + 0.2 + 2 * (1e-3 + 1e-3))
    assert result.margin_s == pytest.approx(result.best.round_trip_s - 0.404)
    sparse = replace(paper, channel=replace(paper.channel, send_rate_hz=100))
    assert certify(sparse).injected_round_trip_s == pytest.approx(0.4 + 2 * (1e-2 + 1e-3))
    plain = replace(paper, channel=ChannelSettings())
    assert certify(plain).injected_round_trip_s == pytest.approx(0.004)


def test_task_damping_is_certified_by_theorem_b(theorem_b: Session) -> None:
    result = certify(theorem_b)
    assert result.best.theorem == "Theorem B"
    assert result.best.round_trip_s == pytest.approx(2 * (0.8 / 1.0 - PERIOD_S))


def test_a_quarter_of_the_damping_needed_leaves_no_margin(theorem_b: Session) -> None:
    weak = DampingSettings((1e-3, 1e-3), (0.05, 0.05))
    session = replace(theorem_b, local=replace(theorem_b.local, damping=weak))
    session = replace(
        session, remote=replace(session.remote, damping=replace(weak, joint_nm_s=(1e-3,) * 3))
    )
    assert certify(session).margin_s < 0.0


def test_the_sampling_ratio_is_the_papers_worst_pose(paper: Session) -> None:
    point = sampling_ratio(paper, SiteId.REMOTE)
    assert point.ratio == pytest.approx(0.74, rel=0.03)
    assert not point.advised
    assert point.stable
    rods = replace(paper.remote, robot=replace(paper.remote.robot, mass="rod"))
    rod = sampling_ratio(replace(paper, remote=rods), SiteId.REMOTE)
    assert rod.ratio == pytest.approx(1.96, rel=0.03)
    assert not rod.stable
    assert sampling_ratio(paper, SiteId.LOCAL).ratio < point.ratio
    assert len(point.pose_rad) == 3


def test_the_same_session_gives_the_same_worst_pose(paper: Session) -> None:
    assert sampling_ratio(paper, SiteId.LOCAL) == sampling_ratio(paper, SiteId.LOCAL)


def test_the_verdict_is_at_the_edge() -> None:
    advised, limit = sampling.ADVISED_RATIO, sampling.LIMIT_LATE_DIFFERENCE
    assert SamplingRatio(SiteId.LOCAL, advised, ()).advised
    assert not SamplingRatio(SiteId.LOCAL, np.nextafter(advised, 1.0), ()).advised
    assert SamplingRatio(SiteId.LOCAL, np.nextafter(limit, 0.0), ()).stable
    assert not SamplingRatio(SiteId.LOCAL, limit, ()).stable


def test_the_filter_counts_where_positions_are_differenced(paper: Session) -> None:
    exact = sampling_ratio(paper, SiteId.LOCAL)
    assert exact.filter_ratio is None
    assert damping_limit(paper, SiteId.LOCAL).bound is Bound.SAMPLING
    device = replace(paper.local.device, encoder_resolution_rad=1e-4, velocity_filter_s=0.003)
    session = replace(paper, local=replace(paper.local, device=device))
    differenced = sampling_ratio(session, SiteId.LOCAL)
    assert differenced.filter_ratio == pytest.approx(3.0 * exact.ratio)
    assert damping_limit(session, SiteId.LOCAL).rate_per_s == pytest.approx(0.5 / 0.003)
    assert damping_limit(session, SiteId.REMOTE).rate_per_s == pytest.approx(400.0)


def test_a_driver_that_does_not_tell_is_taken_to_measure_velocity(paper: Session) -> None:
    @dataclass(frozen=True)
    class Silent:
        driver: str = "silent"

    session = replace(paper, local=replace(paper.local, device=Silent()))
    assert damping_limit(session, SiteId.LOCAL).filter_s is None


def test_the_tighter_bound_is_the_limit() -> None:
    assert DampingLimit(SiteId.LOCAL, 1e-3, None).rate_per_s == pytest.approx(400.0)
    assert DampingLimit(SiteId.LOCAL, 1e-3, 0.0).bound is Bound.SAMPLING
    fast = DampingLimit(SiteId.LOCAL, 1e-3, 0.001)
    assert (fast.rate_per_s, fast.bound) == (pytest.approx(400.0), Bound.SAMPLING)
    slow = DampingLimit(SiteId.LOCAL, 1e-3, 0.002)
    assert (slow.rate_per_s, slow.bound) == (pytest.approx(250.0), Bound.FILTER)


def test_a_filter_too_slow_is_not_advised() -> None:
    limit = sampling.ADVISED_FILTER_RATIO
    assert SamplingRatio(SiteId.LOCAL, 0.1, (), limit).advised
    assert not SamplingRatio(SiteId.LOCAL, 0.1, (), np.nextafter(limit, 1.0)).advised
