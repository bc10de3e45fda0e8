"""Every remedy, written into the session file, certifies; one a little smaller does not."""

from pathlib import Path

import numpy as np
import pytest

from control_law.certificates import Theorem
from site_runtime.advice import Change, Means, Overload, remedies
from site_runtime.certification import (
    DampingLimit,
    certify,
    damping_limit,
    pose_search,
    sampling_ratio,
)
from site_runtime.keys import SiteId
from site_runtime.parts import damping_of
from site_runtime.pose_search import FastestMode
from site_runtime.session import parse_session
from site_runtime.session_edit import edited

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def session_of(name, changes):
    text = (EXPERIMENTS / f"{name}.toml").read_text(encoding="utf-8")
    return parse_session(edited(text, changes), EXPERIMENTS / "of_a_test.toml")


def applied(session, changes):
    return parse_session(edited(session.text, changes), session.path)


LATE = {f"channel.{way}.delay.mean_s": 0.15 for way in ("local_to_remote", "remote_to_local")}
ENCODER = {"remote.device.encoder_resolution_rad": 1e-4}
UNCERTIFIED = {
    "late": ("demo", LATE),
    "uneven": ("demo", {**LATE, "coupling.stiffness_n_per_m": [150.0, 230.0]}),
    "stiff": ("demo", {"coupling.stiffness_n_per_m": [2000.0, 2000.0]}),
    "weak_remote": ("demo", {"remote.damping.task_n_s_per_m": [9.0, 5.0]}),
    "undamped": ("demo", {"local.damping.task_n_s_per_m": [0.0, 0.0]}),
    "filtered": ("demo", {**ENCODER, "coupling.stiffness_n_per_m": [600.0, 600.0]}),
    "paper": ("paper_free", {"coupling.omega": [10.0, 20.0], "coupling.b": [1.0, 0.5]}),
    "slow": ("paper_free", {"coupling.omega": [6.0, 6.0], "channel.send_rate_hz": 4,
                            "engagement.hold_after_s": 1.0}),
    "reordered": ("demo", {**LATE, "channel.local_to_remote.reordering":
                           {"probability": 0.1, "extra_s": 0.02}}),
    "seven": ("seven_dof", {"coupling.stiffness_n_per_m": [500.0, 500.0, 500.0]}),
}  # fmt: skip


@pytest.fixture(scope="module", params=UNCERTIFIED)
def case(request):
    session = session_of(*UNCERTIFIED[request.param])
    assert certify(session).margin_s < 0.0
    return session, remedies(session)


def test_every_remedy_certifies_as_the_file_would_have_it(case):
    session, found = case
    assert found
    for remedy in found:
        after = certify(applied(session, {c.key: c.new for c in remedy.changes}))
        assert after.margin_s > 0.0
        assert after == remedy.certification


def test_no_remedy_is_greater_than_it_must_be(case):
    session, found = case
    for remedy in found:
        if any(change.key.endswith("send_rate_hz") for change in remedy.changes):
            continue
        less = {
            change.key: np.multiply(change.new, 0.98 if change.raised else 1.02).tolist()
            for change in remedy.changes
        }
        assert certify(applied(session, less)).margin_s < 0.0, less


def test_what_is_advised_comes_first_and_the_smallest_change_before_the_others(case):
    _, found = case
    order = [(bool(remedy.overloads), round(remedy.cost, 9)) for remedy in found]
    assert order == sorted(order)
    assert len({remedy.means for remedy in found}) == len(found)


def test_damping_that_is_advised_can_be_sampled_and_what_is_not_cannot(case):
    session, found = case
    for remedy in found:
        if remedy.means not in (Means.TASK_DAMPING, Means.JOINT_DAMPING):
            assert not remedy.overloads
            continue
        after = applied(session, {c.key: c.new for c in remedy.changes})
        touched = [site for site in SiteId if any(site.label in c.key for c in remedy.changes)]
        over = {overload.limit.site for overload in remedy.overloads}
        for site in touched:
            assert sampling_ratio(after, site).advised == (site not in over)


def test_what_a_loop_carries_is_the_edge(case):
    session, found = case
    for overload in (overload for remedy in found for overload in remedy.overloads):
        site, limit = overload.limit.site, overload.limit
        assert limit == damping_limit(session, site)
        assert overload.mode.rate_per_s > limit.rate_per_s
        search = pose_search(session, site)

        def rate(scale, overload=overload, site=site, search=search):
            values = [scale * value for value in overload.carried]
            after = applied(session, {overload.key: values})
            return search.fastest(damping_of(after.site(site).damping)).rate_per_s

        if overload.carried is not None:
            assert rate(1.0) <= limit.rate_per_s < rate(1.02)
        if overload.rate_hz is not None:
            assert overload.mode.rate_per_s / overload.rate_hz <= 0.4


def by_means(name):
    return {remedy.means: remedy for remedy in remedies(session_of(*UNCERTIFIED[name]))}


def new_values(remedy):
    return {change.key: change.new for change in remedy.changes}


def test_a_round_trip_a_little_long_wants_a_little_more_damping():
    """(T/2 + h)K = (0.182 + 0.001)·200 N·s/m at both sites."""
    (first, *_) = remedies(session_of(*UNCERTIFIED["late"]))
    assert new_values(first) == {
        "local.damping.task_n_s_per_m": (36.7, 36.7),
        "remote.damping.task_n_s_per_m": (36.7, 36.7),
    }
    assert first.certification.best.theorem is Theorem.B


def test_only_the_axis_that_needs_it_changes():
    found = by_means("uneven")
    local, remote = new_values(found[Means.TASK_DAMPING]).values()
    assert local[0] == remote[0] == 30.0
    assert local[1] == remote[1] > 40.0
    (stiffness,) = new_values(found[Means.STIFFNESS]).values()
    assert stiffness[0] == 150.0


def test_a_site_that_carries_no_more_lets_the_other_pay():
    found = by_means("filtered")[Means.TASK_DAMPING]
    assert not found.overloads
    values = new_values(found)
    local, remote = (values[f"{site}.damping.task_n_s_per_m"][0] for site in ("local", "remote"))
    assert 30.0 < remote < 49.0 < local  # alike it would be (0.082 + 0.001)·600 = 49.8 each


@pytest.mark.parametrize("stiffness", [580.0, 600.0, 620.0, 640.0, 660.0])
def test_at_its_limit_a_site_is_within_it_also_after_rounding(stiffness):
    changes = ENCODER | {"coupling.stiffness_n_per_m": [stiffness, stiffness]}
    found = next(r for r in remedies(session_of("demo", changes)) if r.means is Means.TASK_DAMPING)
    assert len(found.changes) == 2
    assert not found.overloads


def test_no_rate_is_named_that_the_filter_or_a_session_does_not_allow():
    def rate_hz(mode_per_s, filter_s):
        limit = DampingLimit(SiteId.LOCAL, 1e-3, filter_s)
        return Overload(
            limit, FastestMode(mode_per_s, ()), "local.damping.joint_nm_s", None
        ).rate_hz

    assert rate_hz(480.0, None) == 1200
    assert rate_hz(480.0, 0.001) == 1200
    assert rate_hz(520.0, 0.001) is None
    assert rate_hz(4000.0, None) == 10_000
    assert rate_hz(4001.0, None) is None


def test_from_no_damping_at_one_site_the_other_counts():
    """D = K (h + (T/2)²/(D_r/K − h)), the remote site's 30 N·s/m given."""
    values = new_values(by_means("undamped")[Means.TASK_DAMPING])
    exact = 200.0 * (0.001 + 0.082**2 / (0.15 - 0.001))
    assert values == {"local.damping.task_n_s_per_m": (pytest.approx(exact, rel=0.01),) * 2}


def test_from_no_damping_at_either_site_each_brings_its_half():
    nothing = {f"{site.label}.damping.task_n_s_per_m": [0.0, 0.0] for site in SiteId}
    found = remedies(session_of("demo", nothing))
    values = new_values(next(r for r in found if r.means is Means.TASK_DAMPING))
    assert values == dict.fromkeys(nothing, (16.7, 16.7))  # (0.082 + 0.001)·200, and more


def test_the_papers_coupling_is_lowered_in_its_own_key():
    remedy = by_means("paper")[Means.STIFFNESS]
    (values,) = (new_values(remedy),)
    assert set(values) == {"coupling.omega"}
    # K = Ω b = (10, 10), one stiffness: Theorem A asks the same of both.
    omega = values["coupling.omega"]
    assert omega[1] == pytest.approx(2.0 * omega[0], rel=0.01)


def test_packets_too_rare_are_to_be_sent_more_often():
    remedy = by_means("slow")[Means.ROUND_TRIP]
    ((change),) = remedy.changes
    assert change.key == "channel.send_rate_hz"
    assert change.new > 4
    assert 1000 % change.new == 0


def test_nothing_is_shortened_that_the_file_does_not_inject():
    session = session_of("demo", {"channel.injection": "off", "coupling.stiffness_n_per_m":
                                  [20000.0, 20000.0]})  # fmt: skip
    assert certify(session).margin_s < 0.0
    assert Means.ROUND_TRIP not in {remedy.means for remedy in remedies(session)}


def test_a_recorded_delay_stays_and_the_other_way_is_shortened(tmp_path):
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_s\n0.0,0.1\n1.0,0.15\n")
    session = session_of(
        "demo",
        {
            "channel.local_to_remote.delay": {"model": "trace", "path": str(trace)},
            "channel.remote_to_local.delay": {"model": "constant", "delay_s": 0.15},
        },
    )
    (remedy,) = (r for r in remedies(session) if r.means is Means.ROUND_TRIP)
    # 0.298 s less the trace's 0.15 s and four ticks
    assert new_values(remedy) == {"channel.remote_to_local.delay.delay_s": 0.143}


def test_the_size_of_a_change():
    assert Change("a", (10.0, 20.0), (10.0, 25.0)).relative == pytest.approx(0.2)
    assert Change("a", (10.0, 20.0), (8.0, 20.0)).relative == pytest.approx(0.2)
    assert Change("a", (0.0, 1.0), (0.1, 1.0)).relative == 1.0
    assert Change("a", 4, 5).relative == pytest.approx(0.2)
    assert Change("a", 4, 5).raised
    assert not Change("a", (4.0,), (3.0,)).raised
