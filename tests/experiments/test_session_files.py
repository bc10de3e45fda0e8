"""The session files that come with farhand: valid, certified, and what they claim to be."""

import re
from dataclasses import replace
from math import inf, pi
from pathlib import Path

import numpy as np
import pytest

from channel.delay import SinusoidDelay
from experiments.simulation import Simulation
from site_runtime.certification import certify, sampling_ratio
from site_runtime.derived import derivation
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import HumanArmOperator, SessionFileError, load_session, parse_session
from tests.control_law.chain_distance import midpoint_distance, segment_distance

FOLDER = Path(__file__).parents[2] / "experiments"
FILES = sorted(FOLDER.glob("*.toml"))
PAPER = [FOLDER / f"{name}.toml" for name in ("paper_free", "figure_2", "figure_3")]
THEOREMS = [FOLDER / f"theorem_{letter}.toml" for letter in "ab"]
NUMBER = re.compile(r"(?<![\w.\"/:])-?\d+\.\d+(e-?\d+)?(?![\w.:\"])")


def start(session, site):
    robot = robot_of(session, site)
    q = np.array(session.site(site).device.initial_position_rad)
    return robot.terms(q, np.zeros(robot.joints))


def test_the_files_are_there():
    assert {path.stem for path in FILES} >= {
        *("paper_free", "figure_2", "figure_3", "theorem_a", "theorem_b", "theorems"),
        *("demo", "seven_dof"),
        *("figure_4", "figure_5", "remark_1"),
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_loads_and_is_named_after_itself(path):
    assert load_session(path).name == path.stem


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_comments_and_blank_lines_keep_the_digest(path):
    text = path.read_text(encoding="utf-8")
    stripped = re.sub(r"(?m)\s*#.*$", "", text)
    assert stripped != text
    spaced = "# another comment\n" + text.replace("\n[", "\n\n\n[")
    digests = {parse_session(version, path).digest for version in (text, stripped, spaced)}
    assert len(digests) == 1


@pytest.mark.parametrize("path", [FOLDER / "demo.toml", FOLDER / "figure_2.toml"])
def test_any_number_changed_changes_the_digest(path):
    text = path.read_text(encoding="utf-8")
    digest = parse_session(text, path).digest
    seen = 0
    for number in NUMBER.finditer(text):
        line = text[text.rfind("\n", 0, number.start()) + 1 : number.start()]
        if "#" in line:
            continue
        changed = str(float(number[0]) * 0.99 + (1e-3 if float(number[0]) == 0.0 else 0.0))
        mutated = text[: number.start()] + changed + text[number.end() :]
        try:
            changed_digest = parse_session(mutated, path).digest
        except SessionFileError:
            continue  # a mean below its amplitude, say: refused is told apart, too
        assert changed_digest != digest, line
        seen += 1
    assert seen > 20


@pytest.mark.parametrize("path", [*PAPER, *THEOREMS], ids=lambda path: path.stem)
def test_the_setting_of_section_vi(path):
    session = load_session(path)
    assert session.channel.injection == "exact"
    for direction in (session.channel.local_to_remote, session.channel.remote_to_local):
        assert direction.delay == SinusoidDelay(0.1, 0.1, 1.0, 0.0)
        assert direction.loss is direction.reordering is direction.duplication is None
    assert session.local.device.initial_position_rad == (2 * pi / 3, pi / 2)
    assert session.remote.device.initial_position_rad == (pi / 6, pi / 6, -pi / 6)
    for site in (session.local, session.remote):
        assert set(site.robot.lengths_m) == {0.38}
        assert set(site.robot.masses_kg) == {0.3}
        assert site.robot.mass == "point"
        assert site.limits.torque_nm is site.limits.velocity_rad_s is None
        assert site.limits.workspace_min_m is None
    assert session.coupling.omega == session.coupling.b == (1.0, 1.0)
    assert session.engagement.ramp_s == session.engagement.sub_task_ramp_s == 0.0
    pulses = "pulses" if path.stem.startswith("figure") else "none"
    assert session.local.operator.kind == pulses
    assert session.remote.null_space.regularisation == 0.0
    assert session.remote.null_space.rate_limit_rad_s == inf
    (obstacle,) = session.remote.obstacles
    assert obstacle.center_m == (0.05, 0.35)
    assert (obstacle.safe_radius_m, obstacle.collision_radius_m) == (0.2, 0.1)
    distance = np.linalg.norm(start(session, SiteId.LOCAL).X - start(session, SiteId.REMOTE).X)
    assert distance == pytest.approx(1.481, abs=5e-4)


@pytest.mark.parametrize("path", PAPER, ids=lambda path: path.stem)
def test_the_gains_of_section_vi(path):
    session = load_session(path)
    assert session.local.damping.joint_nm_s == (0.94, 0.94)
    assert session.remote.damping.joint_nm_s == (3.19, 3.20, 3.21)
    assert not any(session.local.damping.task_n_s_per_m + session.remote.damping.task_n_s_per_m)
    paper, theorem_a, theorem_b = certify(session).certificates
    assert 0.4 < paper.round_trip_s < 0.41
    assert theorem_a.round_trip_s == pytest.approx(2.87, abs=0.01)
    assert theorem_b.round_trip_s == 0.0


def test_only_the_named_sub_task_acts():
    tasks = {path.stem: load_session(path).remote.sub_tasks for path in FILES}
    assert tasks["paper_free"] == tasks["theorem_a"] == tasks["theorem_b"] == ()
    (singularity,) = tasks["figure_2"]
    assert (singularity.gain, singularity.direction) == (0.01, (1.0, -2.0, 1.0))
    (obstacle,) = tasks["figure_3"]
    assert (obstacle.kind, obstacle.gain) == ("paper_obstacle", 1.0)


def test_theorem_a_certifies_the_papers_delays_and_hardly_more():
    certification = certify(load_session(FOLDER / "theorem_a.toml"))
    assert certification.best.theorem == "Theorem A"
    assert 0.0 < certification.margin_s < 0.005


@pytest.mark.parametrize("name", ["theorem_b", "theorems", "demo", "seven_dof"])
def test_theorem_b_certifies_the_injected_delays_with_margin(name):
    certification = certify(load_session(FOLDER / f"{name}.toml"))
    assert certification.best.theorem == "Theorem B"
    assert certification.best.round_trip_s > 1.4 * certification.injected_round_trip_s


@pytest.mark.parametrize("name", ["demo", "seven_dof"])
@pytest.mark.parametrize("site", list(SiteId))
def test_the_loop_rate_carries_the_damping(name, site):
    assert sampling_ratio(load_session(FOLDER / f"{name}.toml"), site).ratio < 0.4


def test_the_demo_starts_aligned_and_clear_of_everything():
    session = load_session(FOLDER / "demo.toml")
    local, remote = start(session, SiteId.LOCAL), start(session, SiteId.REMOTE)
    assert np.linalg.norm(local.X - remote.X) < 0.05
    (wall,), (post,) = session.remote.environment.walls, session.remote.obstacles
    assert (remote.X - wall.point_m) @ wall.normal > 0.0
    assert segment_distance(remote.origins, np.array(post.center_m)) > post.collision_radius_m
    for site in (session.local, session.remote):
        box = np.array([site.limits.workspace_min_m, site.limits.workspace_max_m])
        for terms in (local, remote):
            assert np.array_equal(np.clip(terms.X, *box), terms.X)


def test_the_demo_s_hand_presses_through_the_wall_within_reach():
    session = load_session(FOLDER / "demo.toml")
    hand, (wall,) = session.local.operator, session.remote.environment.walls
    assert isinstance(hand, HumanArmOperator)
    assert hand.center_m[0] + hand.amplitude_m[0] > wall.point_m[0] > hand.center_m[0]
    farthest = np.hypot(*(np.array(hand.center_m) + hand.amplitude_m))
    assert farthest < 0.9 * robot_of(session, SiteId.LOCAL).reach_m[0]
    assert max(hand.frequency_hz) * 10.0 > 1.0  # a full turn within ten seconds


@pytest.mark.parametrize("name", ["figure_4", "figure_5", "remark_1"])
def test_the_paper_s_delays_are_certified_by_theorem_b_and_carried_by_the_loop(name):
    session = load_session(FOLDER / f"{name}.toml")
    assert session.channel.injection == "exact"
    for direction in (session.channel.local_to_remote, session.channel.remote_to_local):
        assert direction.delay == SinusoidDelay(0.1, 0.1, 1.0, 0.0)
    certification = certify(session)
    assert certification.best.theorem == "Theorem B"
    assert certification.best.round_trip_s > 1.15 * certification.injected_round_trip_s
    for site in SiteId:
        ratio = sampling_ratio(session, site)
        assert ratio.advised
        device = session.site(site).device
        if device.encoder_resolution_rad > 0.0:  # the filter's pole pair is then well damped
            assert ratio.ratio * session.loop.rate_hz * device.velocity_filter_s <= 0.5


@pytest.mark.parametrize("name", ["figure_4", "figure_5"])
def test_the_bench_of_section_vi(name):
    session = load_session(FOLDER / f"{name}.toml")
    assert session.local.robot.lengths_m == (0.21, 0.252)
    assert session.remote.robot.lengths_m == (0.254, 0.1405, 0.21, 0.17)
    for site in (session.local, session.remote):
        assert site.robot.masses_kg[-2:] == (0.055, 0.075)
        assert site.robot.gravity_m_s2 == (0.0, 0.0)
        assert site.device.encoder_resolution_rad * 0.21 == pytest.approx(3e-5, rel=0.05)
        assert site.device.coulomb_friction_nm / 0.252 == pytest.approx(0.04, rel=0.05)
        assert site.device.torque_limit_nm / 0.17 == pytest.approx(8.5, rel=0.05)


@pytest.mark.parametrize("name", ["figure_4", "figure_5", "remark_1"])
def test_both_robots_start_at_one_point_away_from_singular_poses(name):
    session = load_session(FOLDER / f"{name}.toml")
    local, remote = start(session, SiteId.LOCAL), start(session, SiteId.REMOTE)
    assert np.linalg.norm(local.X - remote.X) < 1e-3
    for site, terms in ((SiteId.LOCAL, local), (SiteId.REMOTE, remote)):
        assert np.linalg.norm(terms.X) < 0.9 * robot_of(session, site).reach_m[0]
    lengths = session.local.robot.lengths_m
    largest = np.prod(np.square(lengths))
    assert np.linalg.det(local.J @ local.J.T) > 0.4 * largest


def test_only_the_obstacle_tells_figure_5_s_bench_from_figure_4_s():
    four, five = (load_session(FOLDER / f"figure_{number}.toml") for number in (4, 5))
    assert four.remote.sub_tasks == four.remote.obstacles == ()
    (task,), (obstacle,) = five.remote.sub_tasks, five.remote.obstacles
    assert (task.kind, task.gain) == ("paper_obstacle", 1.0)
    assert five.remote.null_space.regularisation == 0.0
    assert five.remote.null_space.rate_limit_rad_s == inf
    assert obstacle.center_m == (0.3, -0.12)
    assert (obstacle.safe_radius_m, obstacle.collision_radius_m) == (0.18, 0.1)
    origins = start(five, SiteId.REMOTE).origins
    assert midpoint_distance(origins, np.array(obstacle.center_m)) > obstacle.safe_radius_m + 0.05
    for part in ("coupling", "channel", "engagement", "loop"):
        assert getattr(four, part) == getattr(five, part)
    assert replace(four.local, operator=five.local.operator) == five.local
    for part in ("robot", "damping", "device"):
        assert getattr(four.remote, part) == getattr(five.remote, part)


def test_figure_5_s_hand_leads_the_arm_into_the_obstacle_unless_it_is_avoided():
    session = load_session(FOLDER / "figure_5.toml")
    (obstacle,) = session.remote.obstacles
    unaware = replace(session, remote=replace(session.remote, sub_tasks=()))
    last_pulse_s = session.local.operator.pulses[-1].end_s
    nearest = []
    for variant in (unaware, session):
        run = Simulation(variant).run(last_pulse_s + 0.5)
        assert not run.failures
        derived = derivation(session)("remote", run.remote["q"])
        nearest.append(derived["midpoint_distance_m"].min())
        error = np.linalg.norm(run.local["position_m"] - run.remote["position_m"], axis=1)
        assert error.max() < 0.03
        assert error[-1] < 0.0015
    without, avoiding = nearest
    assert without < obstacle.collision_radius_m
    assert avoiding > 0.95 * obstacle.safe_radius_m


def test_remark_1_s_wall_carries_the_hand_s_force():
    session = load_session(FOLDER / "remark_1.toml")
    assert session.local.robot.lengths_m == (0.38,) * 2
    assert session.remote.robot.lengths_m == (0.38,) * 3
    assert session.local.robot.masses_kg + session.remote.robot.masses_kg == (0.3,) * 5
    (wall,), hand = session.remote.environment.walls, session.local.operator
    assert (wall.point_m, wall.normal) == ((0.3, 0.0), (-1.0, 0.0))
    assert start(session, SiteId.REMOTE).X[0] < wall.point_m[0]
    assert hand.force_n == (2.5, 0.0)
    assert hand.start_s >= session.engagement.ramp_s
    assert session.coupling.force_ceiling_n[0] > hand.force_n[0]
    run = Simulation(session).run(14.0)
    assert not run.failures
    forces = run.local["external_force_n"][-1] + run.remote["external_force_n"][-1]
    assert np.abs(forces).max() < 1e-3
    assert run.remote["external_force_n"][-1][0] == pytest.approx(-2.5, abs=1e-3)
    assert np.abs(run.local["velocity_m_s"][-1]).max() < 1e-5


def test_the_bench_s_drivers_move_figure_5_s_robots_with_its_gains():
    bench, figure_5 = (load_session(FOLDER / f"{name}.toml") for name in ("bench_fake", "figure_5"))
    assert bench.coupling == figure_5.coupling
    assert certify(bench).margin_s > 0.0
    for site in SiteId:
        own, simulated = bench.site(site), figure_5.site(site)
        assert own.robot == simulated.robot
        assert own.damping == simulated.damping
    assert bench.remote.obstacles == figure_5.remote.obstacles
    assert bench.remote.null_space == figure_5.remote.null_space
    assert bench.remote.sub_tasks == figure_5.remote.sub_tasks
    directions = ("local_to_remote", "remote_to_local")
    for direction in directions:
        delay = getattr(bench.channel, direction).delay
        assert delay.delay_s == getattr(figure_5.channel, direction).delay.mean_s
