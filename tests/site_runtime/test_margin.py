from dataclasses import replace
from math import inf, isnan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from control_law.certificates import Theorem, round_trip
from site_runtime.certification import certify
from site_runtime.margin import Margin, margin_of
from site_runtime.session import Session, StiffnessCoupling, load_session
from site_runtime.session_edit import edited

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
MS = 1_000_000
HOLD_S = 1e-3
RELAXED = st.floats(0.005, 1.0)
PAIRS = st.tuples(
    st.tuples(RELAXED, RELAXED).map(lambda pair: tuple(np.array([x]) for x in pair)),
    st.tuples(st.tuples(RELAXED, RELAXED), st.tuples(RELAXED, RELAXED)).map(
        lambda pair: tuple(np.array(side) for side in pair)
    ),
)


def certified(relaxations) -> float:
    """By the better theorem: each by its worst axis."""
    return max(float(round_trip(l, r, HOLD_S).min()) for l, r in relaxations)  # noqa: E741


def margin(relaxations, *, derate: bool = True) -> Margin:
    return Margin(certified(relaxations), relaxations, MS, derate=derate)


def bound_ns(loop_s: float) -> int:
    """What the channel says of a loop that is so old: at ticks, a period a site less."""
    return round(loop_s * 1e9) - 2 * MS


@given(relaxations=PAIRS, within=st.floats(0.0, 1.0), beyond=st.floats(1.0, 50.0))
def test_the_share_is_one_within_and_beyond_what_puts_the_edge_at_the_age(
    relaxations, within: float, beyond: float
) -> None:
    edge_s = certified(relaxations)
    assert margin(relaxations).share(bound_ns(within * edge_s) - 1) == 1.0
    loop_s = beyond * edge_s + 1e-4
    share = margin(relaxations).share(bound_ns(loop_s))
    assert 0.0 < share < 1.0
    scaled = [(local / share, remote / share) for local, remote in relaxations]
    assert certified(scaled) == pytest.approx(loop_s, abs=2e-9, rel=1e-9)
    # no greater share is proven by either
    greater = [(local / (share * 1.001), remote / (share * 1.001)) for local, remote in relaxations]
    assert certified(greater) < loop_s


@given(relaxations=PAIRS, ages=st.lists(st.floats(0.0, 5.0), min_size=2))
def test_an_older_loop_never_gets_a_greater_share(relaxations, ages: list[float]) -> None:
    of_loop = margin(relaxations)
    shares = [of_loop.share(bound_ns(age)) for age in sorted(ages)]
    assert shares == sorted(shares, reverse=True)


def test_exactly_at_the_certified_age_all_of_the_gains_are_proven() -> None:
    relaxed = (np.array([0.201]), np.array([0.201]))
    exact = Margin(0.4, (relaxed,), MS, derate=True)
    assert exact.share(398 * MS) == 1.0
    assert exact.loop_s == 0.4
    assert exact.share(398 * MS + 1000) < 1.0


def test_an_unknown_age_proves_nothing() -> None:
    unknown = margin(((np.array([1.0]), np.array([1.0])),))
    unknown.share(5 * MS)
    assert unknown.loop_s == pytest.approx(7e-3)
    assert unknown.share(None) == 0.0
    assert isnan(unknown.loop_s)


@given(age_ns=st.none() | st.integers(-(10**18), 10**18))
def test_a_warning_scales_nothing(age_ns: int | None) -> None:
    warned = margin(((np.array([0.1]), np.array([0.1])),), derate=False)
    assert warned.share(age_ns) == 1.0
    assert isnan(warned.loop_s) == (age_ns is None)


def test_a_theorem_that_proves_nothing_leaves_it_to_the_other() -> None:
    none, some = np.zeros(2), np.array([0.1])
    both = Margin(0.198, ((none, none), (some, some)), MS, derate=True)
    alone = Margin(0.198, ((some, some),), MS, derate=True)
    assert both.share(300 * MS) == alone.share(300 * MS) > 0.0
    assert Margin(0.0, ((none, none),), MS, derate=True).share(300 * MS) == 0.0


@given(
    relaxations=PAIRS,
    beyond=st.floats(1.0, 20.0),
    lower=st.floats(0.01, 1.0),
    weaker=st.integers(0, 1),
)
def test_sites_with_unequal_shares_are_both_proven(
    relaxations, beyond: float, lower: float, weaker: int
) -> None:
    """Proposition 5: each site's relaxation is divided by its own share; the smaller one helps."""
    loop_s = beyond * certified(relaxations) + 1e-4
    share = margin(relaxations).share(bound_ns(loop_s))
    shares = [share, share]
    shares[weaker] *= lower
    scaled = [(local / shares[0], remote / shares[1]) for local, remote in relaxations]
    assert certified(scaled) >= loop_s - 1e-8


@pytest.fixture(scope="module")
def demo() -> Session:
    return load_session(EXPERIMENTS / "demo.toml")


def scaled_session(session: Session, share: float) -> Session:
    """The session with stiffness and ceiling scaled, as an editor would write it."""
    coupling = session.coupling
    assert isinstance(coupling, StiffnessCoupling)
    return replace(
        session,
        coupling=replace(
            coupling,
            stiffness_n_per_m=tuple(share * k for k in coupling.stiffness_n_per_m),
            force_ceiling_n=tuple(share * f for f in coupling.force_ceiling_n),
        ),
    )


def test_a_scaled_session_file_is_the_scaled_session(demo: Session, tmp_path: Path) -> None:
    coupling = demo.coupling
    assert isinstance(coupling, StiffnessCoupling)
    path = tmp_path / "half.toml"
    changes = {
        "coupling.stiffness_n_per_m": [0.5 * k for k in coupling.stiffness_n_per_m],
        "coupling.force_ceiling_n": [0.5 * f for f in coupling.force_ceiling_n],
    }
    path.write_text(edited(demo.path.read_text(encoding="utf-8"), changes), encoding="utf-8")
    assert certify(load_session(path)).best == certify(scaled_session(demo, 0.5)).best


@given(beyond=st.floats(0.0, 30.0))
def test_the_demos_gains_scaled_by_its_margin_are_certified_for_the_age(
    demo: Session, beyond: float
) -> None:
    of_demo = margin_of(demo)
    assert of_demo.certified_s == certify(demo).best.round_trip_s
    share = of_demo.share(bound_ns(beyond * of_demo.certified_s))
    assert (share == 1.0) == (of_demo.loop_s <= of_demo.certified_s)
    best = certify(scaled_session(demo, share)).best
    assert best.round_trip_s >= of_demo.loop_s - 1e-9
    if share < 1.0:
        assert best.theorem is not Theorem.PAPER
        assert best.round_trip_s == pytest.approx(of_demo.loop_s)


def test_a_session_that_warns_has_a_margin_that_only_warns(demo: Session) -> None:
    warned = replace(
        demo, engagement=replace(demo.engagement, beyond_certificate="warn", align_within_m=inf)
    )
    assert margin_of(warned).share(10**12) == 1.0
    assert margin_of(demo).share(10**12) < 0.01
