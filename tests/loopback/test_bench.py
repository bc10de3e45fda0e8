"""The whole bench of Figs. 4 and 5 through its drivers, held against the plain simulated run.

Hand and JR3 → PHANToM driver ↔ Zenoh ↔ PHANToM and Quanser drivers: the daemons are those of any
session, the vendors' libraries, board and bus are fakes, each a process or thread of its own on its
own clock, and behind them figure_5.toml's robots and hand are simulated in two more processes.

What the two runs may differ by: torques and positions are some milliseconds older (servo loops,
plants and site are not in step), encoders and filters are the drivers', torque ramps in.
"""

import os
import subprocess
import sys
import time
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from experiments.simulation import Run, Simulation
from farhand.feed import Feed
from site_runtime.derived import derivation
from site_runtime.keys import SiteId
from site_runtime.session import Session, load_session
from site_runtime.supervisor import State
from telemetry.rows import RowArray
from tests.fakes.bench import ROOT, device_coordinates, fakes
from tests.fakes.hd import fake_hd
from tests.fakes.plant import ENVIRONMENT_VARIABLE, PlantMemory
from tests.loopback.test_two_processes import free_endpoints

pytestmark = pytest.mark.processes

BENCH = ROOT / "experiments" / "bench_fake.toml"
FIGURE_5 = ROOT / "experiments" / "figure_5.toml"
HAND_S = 19.5  # its script ends at 18 s
REST_S = 11.5  # between its push and its pull
CARRIED = 0.03  # share of ticks that a machine may miss
STALL_S = 0.03  # and the latest tick that it may run
TRIES = 3
PUSH_N = 1.6

# Nothing but damping says where free arms are: what a stall adds to their way, while they move at
# 40 mm/s, stays in it. Runs with up to 1 % of the ticks missed were 1 to 24 mm off. What the law
# holds, and the rest of the figures, are compared at about four times what was seen.
AT_REST_M = 0.05
MOVING_M = 0.05
APART_M = 0.004
MIDPOINT_M = 0.002
FORCE_N = 0.03
SAME_RAD = 0.005  # encoders and what is left of the motion


@dataclass
class Outcome:
    """Rows of both sites with the hand's time [s], and what the daemons printed."""

    rows: dict[SiteId, RowArray]
    time_s: dict[SiteId, np.ndarray]
    printed: str
    plant_rad: dict[SiteId, np.ndarray]

    def position_m(self, site: SiteId, at_s: float) -> np.ndarray:
        rows, time_s = self.rows[site], self.time_s[site]
        return np.array([np.interp(at_s, time_s, axis) for axis in rows["position_m"].T])

    def latest_s(self, site: SiteId) -> float:
        """How late the latest tick came while the hand was there."""
        there = (self.time_s[site] > 0.0) & (self.time_s[site] < HAND_S)
        return float(self.rows[site]["lateness_ns"][there].max()) * 1e-9

    def apart_m(self, at_s: float) -> float:
        ends = [self.position_m(site, at_s) for site in SiteId]
        return float(np.linalg.norm(ends[0] - ends[1]))


@pytest.fixture(scope="module")
def session() -> Session:
    return load_session(BENCH)


@pytest.fixture(scope="module")
def plain(session: Session) -> Outcome:
    """figure_5.toml simulated, with the bench's rate and delays."""
    figure_5 = load_session(FIGURE_5)
    run = Simulation(replace(figure_5, channel=session.channel, loop=session.loop)).run(HAND_S)
    assert run.failures == ()
    return outcome(run, "", {})


@pytest.fixture(scope="module")
def bench(session: Session) -> Outcome:
    if reason := fake_hd.missing():
        pytest.skip(reason)
    for _ in range(TRIES):
        found = outcome(*run_bench(session))
        missed = max(rows["missed"][-1] / len(rows) for rows in found.rows.values())
        stall_s = max(found.latest_s(site) for site in SiteId)
        if missed < CARRIED and stall_s < STALL_S:
            return found
    pytest.skip(
        f"this machine misses {missed:.1%} of the ticks, or runs one {stall_s * 1e3:.0f} ms late: "
        "it is too busy for a dozen processes\n" + found.printed
    )


def outcome(run: Run, printed: str, plant_rad: dict[SiteId, np.ndarray]) -> Outcome:
    """Count time from the hand's: it is a second before it first pushes."""
    rows = {SiteId.LOCAL: run.local, SiteId.REMOTE: run.remote}
    push_n = run.local["external_force_n"][:, 0]
    half = int(np.argmax(push_n > 0.5 * PUSH_N))  # of a sin² from second 1 to 9: at second 3
    assert half > 0, f"no hand was felt\n{printed}"
    start_ns = run.local["stamp_ns"][half] - 3_000_000_000
    time_s = {site: (own["stamp_ns"] - start_ns) * 1e-9 for site, own in rows.items()}
    return Outcome(rows, time_s, printed, plant_rad)


def run_bench(session: Session) -> tuple[Run, str, dict[SiteId, np.ndarray]]:
    """Return both sites' rows, what they printed, and where the plants' joints really were."""
    endpoints = dict(zip(SiteId, free_endpoints(2), strict=True))
    rows: dict[SiteId, list[RowArray]] = {site: [] for site in SiteId}
    with ExitStack() as stack:
        environments = {
            site: stack.enter_context(fakes(session, site, FIGURE_5)) for site in SiteId
        }
        feed = stack.enter_context(closing(Feed(session, tuple(endpoints.values()))))
        daemons = []
        for site in (SiteId.REMOTE, SiteId.LOCAL):
            options = ["--quiet", "--duration", f"{HAND_S + 2.0}", "--listen", endpoints[site]]
            if site is SiteId.LOCAL:
                options += ["--connect", endpoints[SiteId.REMOTE]]
            daemon = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", f"{site.label}_site", str(BENCH), *options],
                    cwd=ROOT,
                    env=os.environ | environments[site],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            )
            with suppress(OSError):  # the network's threads, which ask for no real time
                os.setpriority(os.PRIO_PROCESS, daemon.pid, -15)
            daemons.append(daemon)
        while any(daemon.poll() is None for daemon in daemons):
            for batch, _ in feed.receive():
                rows[SiteId(batch.site)].append(batch.rows)
            time.sleep(0.02)
        printed = "\n".join(daemon.communicate()[0] for daemon in daemons)
        plant_rad = {site: joints_rad(session, site, environments[site]) for site in SiteId}
    assert all(rows.values()), printed
    return Run(*(np.concatenate(rows[site]) for site in SiteId), ()), printed, plant_rad


def joints_rad(session: Session, site: SiteId, environment: dict[str, str]) -> np.ndarray:
    """Serial joint angles of a plant, by the coordinates that it was started with."""
    plant = PlantMemory(Path(environment[ENVIRONMENT_VARIABLE]))
    A, b = device_coordinates(session.site(site).device)
    d = np.array(plant.read().position_rad)
    plant.close()
    return np.asarray(A @ d + b)


def test_both_sites_engage_and_stay_so(bench: Outcome) -> None:
    assert "FAULT" not in bench.printed, bench.printed
    for site, rows in bench.rows.items():
        driven = rows[(bench.time_s[site] > 0.5) & (bench.time_s[site] < HAND_S - 0.5)]
        assert (driven["state"] == State.ENGAGED).mean() > 0.97, bench.printed


@pytest.mark.parametrize("site", SiteId)
def test_the_drivers_say_where_the_joints_really_are(bench: Outcome, site: SiteId) -> None:
    moved_rad = np.ptp(bench.rows[site]["q"], axis=0)
    assert moved_rad.min() > 10.0 * SAME_RAD
    np.testing.assert_allclose(bench.rows[site]["q"][-1], bench.plant_rad[site], 0.0, SAME_RAD)


def test_the_sensor_feels_the_hand_as_it_pushes_and_pulls(bench: Outcome, plain: Outcome) -> None:
    force_n = bench.rows[SiteId.LOCAL]["external_force_n"]
    time_s = bench.time_s[SiteId.LOCAL]
    expected = plain.rows[SiteId.LOCAL]["external_force_n"]
    for axis in range(2):
        wanted = np.interp(time_s, plain.time_s[SiteId.LOCAL], expected[:, axis])
        felt = time_s < HAND_S - 0.5
        assert np.median(np.abs(force_n[felt, axis] - wanted[felt])) < FORCE_N
    assert force_n[:, 0].max() == pytest.approx(PUSH_N, abs=FORCE_N)
    assert force_n[:, 1].min() == pytest.approx(-2.2, abs=FORCE_N)


@pytest.mark.parametrize("site", SiteId)
def test_the_arms_come_to_rest_where_the_simulated_ones_do(
    bench: Outcome, plain: Outcome, site: SiteId
) -> None:
    for at_s in (REST_S, HAND_S - 0.5):
        apart_m = np.linalg.norm(bench.position_m(site, at_s) - plain.position_m(site, at_s))
        assert apart_m < AT_REST_M, f"{apart_m * 1e3:.1f} mm apart at {at_s} s"
    moved_m = plain.position_m(site, HAND_S - 0.5) - plain.position_m(site, REST_S)
    assert np.linalg.norm(moved_m) > 2.5 * AT_REST_M  # or the comparison would say little


@pytest.mark.parametrize("site", SiteId)
def test_the_arms_move_as_the_simulated_ones_do(
    bench: Outcome, plain: Outcome, site: SiteId
) -> None:
    for at_s in np.arange(0.5, HAND_S - 0.5, 0.5):
        apart_m = np.linalg.norm(bench.position_m(site, at_s) - plain.position_m(site, at_s))
        assert apart_m < MOVING_M, f"{apart_m * 1e3:.1f} mm apart at {at_s} s"


def test_the_remote_arm_follows_as_closely(bench: Outcome, plain: Outcome) -> None:
    for at_s in np.arange(0.5, HAND_S - 0.5, 0.5):
        assert bench.apart_m(at_s) == pytest.approx(plain.apart_m(at_s), abs=APART_M)
    assert bench.apart_m(HAND_S - 0.5) < 0.003


def test_the_links_keep_as_far_from_the_obstacle(bench: Outcome, plain: Outcome) -> None:
    derive = derivation(load_session(FIGURE_5))
    nearest_m, expected_m = (
        np.nanmin(derive("remote", found.rows[SiteId.REMOTE]["q"])["midpoint_distance_m"])
        for found in (bench, plain)
    )
    assert expected_m < 0.18  # the avoidance acts
    assert nearest_m == pytest.approx(expected_m, abs=MIDPOINT_M)
