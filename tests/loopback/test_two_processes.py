"""Both daemons as real processes over real Zenoh, watched by a third peer through their telemetry.

All three are on one machine, so all stamps are on one CLOCK_MONOTONIC: what a site says about the
age of its peer's samples can be held against the peer's own record.
"""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from string import Template

import numpy as np
import numpy.typing as npt
import pytest

from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.supervisor import DRIVEN, State
from telemetry.rows import NO_PEER_STATE, RowArray
from telemetry.stream import decode_batch
from tests.ports import free_port

FloatArray = npt.NDArray[np.float64]

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
BOTH = (LOCAL, REMOTE)
DEADLINE_S = 30.0
ORPHAN_S = 150  # a daemon whose test was killed ends by itself

TICK_S = 0.002
TO_REMOTE_S, TO_LOCAL_S = 0.03, 0.05
TORQUE_LIMIT_NM = 40.0
CONVERGED_M = 0.003
LATE_S = 10 * TICK_S  # what medians may lose to a crowded machine

# Theorem B: the gains are proven for a round trip of 2 D/K = 0.3 s. Heavy links and weak gains,
# so that a tick late by tens of milliseconds leaves the simulated arms calm. With gravity: an arm
# whose torque fails falls. The arms start 0.3 m apart, so that a point not blended in is a jump.
SESSION = Template("""
format = 1
name = "loopback"
loop = { rate_hz = 500 }
real_time = { mode = "try" }
task = { dimension = 2 }
coupling = { law = "stiffness", stiffness_n_per_m = $stiffness, force_ceiling_n = [20.0, 20.0] }
engagement = { alignment = "none", ramp_s = $ramp_s, hold_after_s = $hold_after_s, blend_s = 0.5 }

[channel]
injection = "exact"
local_to_remote = { delay = { model = "constant", delay_s = 0.03 } }
remote_to_local = { delay = { model = "constant", delay_s = 0.05 } }

[network]
local_listen = "$local_endpoint"
remote_listen = "$remote_endpoint"
local_connect = "$remote_endpoint"
lease_s = $lease_s

[local]
operator = $operator
damping = { joint_nm_s = [0.2, 0.2], task_n_s_per_m = [15.0, 15.0] }
limits = { torque_nm = [40.0, 40.0] }
device = { driver = "simulated", initial_position_rad = [-0.3, 1.65] }

[local.robot]
kind = "planar"
lengths_m = [0.4, 0.4]
masses_kg = [1.0, 1.0]
gravity_m_s2 = [0.0, -9.81]

[remote]
damping = { joint_nm_s = [0.2, 0.2, 0.2], task_n_s_per_m = [15.0, 15.0] }
limits = { torque_nm = [40.0, 40.0, 40.0] }
device = { driver = "simulated", initial_position_rad = [1.9, -0.9, -1.3] }

[remote.robot]
kind = "planar"
lengths_m = [0.4, 0.4, 0.4]
masses_kg = [1.0, 1.0, 1.0]
gravity_m_s2 = [0.0, -9.81]
""")
DEFAULTS = {
    "stiffness": "[100.0, 100.0]",
    "ramp_s": "0.2",
    "hold_after_s": "0.3",
    "lease_s": "0.5",
    "operator": '{ kind = "none" }',
}
MOVING_HAND = """{ kind = "human_arm", stiffness_n_per_m = 400.0, damping_n_s_per_m = 20.0, \
force_limit_n = 30.0, center_m = [0.45, 0.3], amplitude_m = [0.1, 0.1], frequency_hz = [0.4, 0.4], \
phase_rad = [0.0, 1.5] }"""


class Daemon:
    """One `python -m ..._site`, its output in a file."""

    def __init__(self, site: SiteId, session: Path, *options: str) -> None:
        self.site = site
        self.log = session.with_name(f"{time.monotonic_ns()}_{site.label}.log")
        command = [sys.executable, "-m", f"{site.label}_site", str(session), *options]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)

    def ended(self) -> int:
        """Wait for its own end; return the exit code."""
        return self.process.wait(DEADLINE_S)

    def stop(self, number: int = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.ended()

    def text(self) -> str:
        """The words it printed, without frames: no assertion hangs on where lines wrap."""
        return " ".join(re.sub("[─-╿]", " ", self.log.read_text(encoding="utf-8")).split())

    def kill(self) -> None:
        """As the kernel would; returns when it is gone. Works on a suspended process too."""
        self.process.kill()
        self.process.wait()


class Rig:
    """The daemons of one test, and a third peer that hears their telemetry from the first row.

    The peer listens and every daemon connects to it: whoever dials first waits least.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.observer, self.local_endpoint, self.remote_endpoint = free_endpoints(3)
        # its lease outlasts every suspension, or the rows that follow one would be lost
        self._node = ZenohNode(ZenohSettings(listen=(self.observer,), lease_ms=30_000))
        self._subscriptions = {
            site: self._node.subscriber(telemetry_key("loopback", site), 4096) for site in BOTH
        }
        self._runs: dict[SiteId, dict[int, list[RowArray]]] = {LOCAL: {}, REMOTE: {}}
        self.daemons: list[Daemon] = []

    def close(self) -> None:
        for daemon in self.daemons:
            daemon.kill()
        self._node.close()

    def session(self, name: str = "session", **changes: str) -> Path:
        """Write a session file with this test's endpoints, and `changes` to the defaults."""
        endpoints = {
            "local_endpoint": self.local_endpoint,
            "remote_endpoint": self.remote_endpoint,
        }
        path = self._folder / f"{name}.toml"
        path.write_text(SESSION.substitute(DEFAULTS | endpoints | changes), encoding="utf-8")
        return path

    def start(self, site: SiteId, session: Path, *options: str) -> Daemon:
        connect = ["--connect", self.observer]
        if site is LOCAL:
            connect += ["--connect", self.remote_endpoint]
        return self.start_as_given(site, session, *connect, *options)

    def start_as_given(self, site: SiteId, session: Path, *options: str) -> Daemon:
        if "--duration" not in options:
            options = (*options, "--duration", str(ORPHAN_S))
        daemon = Daemon(site, session, *options)
        self.daemons.append(daemon)
        return daemon

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + DEADLINE_S
        while not condition():
            if time.monotonic() > end:
                pytest.fail(f"not within {DEADLINE_S} s: {what}\n{self.history()}")
            time.sleep(0.01)

    def runs(self, site: SiteId) -> list[list[RowArray]]:
        """The batches of each run of the site so far."""
        for _, payload in self._subscriptions[site].receive():
            batch = decode_batch(payload)
            assert batch.site == site
            self._runs[site].setdefault(batch.epoch, []).append(batch.rows)
        return list(self._runs[site].values())

    def rows(self, site: SiteId) -> RowArray:
        """Every row of the site's present run so far."""
        runs = self.runs(site)
        return np.concatenate(runs[-1]) if runs else np.zeros(0, dtype=[("state", "u1")])

    def history(self) -> str:
        """What the daemons printed, and the last state of each of their runs, for failures."""
        printed = [f"{daemon.site.label}: {daemon.text()}" for daemon in self.daemons]
        states = [
            f"{site.label}: {State(run[-1]['state'][-1]).name} after {sum(map(len, run))} rows; "
            f"peer {run[-1]['peer_state'][-1]}, loop {run[-1]['loop_bound_s'][-1]} s, "
            f"late {run[-1]['lateness_ns'][-1]} ns, rejected {run[-1]['rejected'][-1].sum()}"
            for site in BOTH
            for run in self.runs(site)
        ]
        return "\n".join(printed + states)

    def state(self, site: SiteId) -> State | None:
        rows = self.rows(site)
        return State(rows["state"][-1]) if len(rows) else None

    def until_state(self, site: SiteId, state: State) -> None:
        self.until(lambda: self.state(site) is state, f"{site.label} {state.name}")

    def until_peer_state(self, site: SiteId, state: State) -> None:
        """Wait for the state of the peer sample in use, so after the delay."""
        self.until(
            lambda: self.rows(site)["peer_state"][-1] == state,
            f"{site.label} using a sample of a peer in {state.name}",
        )

    def until_engaged(self) -> None:
        self.until(lambda: all(self.state(s) is State.ENGAGED for s in BOTH), "both ENGAGED")

    def until_more(self, site: SiteId, rows: int) -> RowArray:
        """Wait for so many rows from now on, and return them."""
        before = len(self.rows(site))
        self.until(lambda: len(self.rows(site)) >= before + rows, f"{rows} rows of {site.label}")
        return self.rows(site)[before:]

    def until_converged(self) -> None:
        """Both ENGAGED, and each at its peer's point for a fifth of a second: not just passing."""

        def near() -> bool:
            recent = [self.rows(site)[-100:] for site in BOTH]
            return all(
                bool((rows["state"] == State.ENGAGED).all() and error_m(rows).max() < CONVERGED_M)
                for rows in recent
            )

        self.until_engaged()
        self.until(near, "error below a few mm")


def free_endpoints(count: int) -> list[str]:
    return [f"tcp/127.0.0.1:{free_port()}" for _ in range(count)]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def error_m(rows: RowArray) -> FloatArray:
    """Distance of each row's end effector from the point that it was driven to."""
    return np.asarray(np.linalg.norm(rows["position_m"] - rows["peer_position_m"], axis=1))


def largest_resuming_jump_n(rows: RowArray) -> float:
    """Change of the coupling force from the last tick of a HOLD to the next tick, ENGAGED."""
    state, force_n = rows["state"], rows["coupling_force_n"]
    next_tick = np.diff(rows["sequence"]) == 1  # a batch may be lost
    held = np.flatnonzero((state[:-1] == State.HOLD) & (state[1:] == State.ENGAGED) & next_tick)
    assert len(held) > 0
    return float(np.abs(force_n[held + 1] - force_n[held]).max())


def first_engagement(rows: RowArray) -> RowArray:
    """The rows from the first ENGAGED one on, as long as it lasts without a HOLD."""
    start = int(np.argmax(rows["state"] == State.ENGAGED))
    left = np.flatnonzero(rows["state"][start:] != State.ENGAGED)
    return rows[start : start + int(left[0]) if len(left) else None]


def true_ages_s(rows: RowArray, peer_rows: RowArray) -> tuple[FloatArray, FloatArray]:
    """Ages by the peer's own record, and by the site itself, of the peer positions it was using.

    A position that the peer was at in one tick alone tells which sample was used.
    """
    positions, where, counts = np.unique(
        peer_rows["position_m"], axis=0, return_index=True, return_counts=True
    )
    stamps_ns = {
        position.tobytes(): peer_rows["stamp_ns"][index]
        for position, index, count in zip(positions, where, counts, strict=True)
        if count == 1
    }
    known = [(row, stamps_ns.get(row["peer_position_m"].tobytes())) for row in rows]
    found = [(row["stamp_ns"] - at, row["one_way_delay_s"]) for row, at in known if at is not None]
    assert len(found) > 100
    true_ns, reported_s = np.array(found).T
    return true_ns * 1e-9, reported_s


def test_sites_meet_converge_and_measure_their_delay(rig: Rig) -> None:
    session = rig.session()
    local = rig.start(LOCAL, session)
    rig.until_state(LOCAL, State.READY)
    waiting = rig.until_more(LOCAL, 100)
    assert (waiting["state"] == State.READY).all()
    assert (waiting["peer_state"] == NO_PEER_STATE).all()
    assert (waiting["torque_nm"] == 0.0).all()
    assert np.ptp(waiting["position_m"], axis=0).max() == 0.0

    remote = rig.start(REMOTE, session)
    rig.until_converged()
    for site in BOTH:
        rig.until_more(site, 500)
    for site, peer, delay_s in ((LOCAL, REMOTE, TO_LOCAL_S), (REMOTE, LOCAL, TO_REMOTE_S)):
        rows = rig.rows(site)
        ready = rows[rows["state"] == State.READY]
        assert len(ready) > 0
        assert (ready["torque_nm"] == 0.0).all()
        assert (np.abs(rows["torque_nm"]) <= TORQUE_LIMIT_NM).all()
        engaged = first_engagement(rows)
        injected_s = TO_REMOTE_S + TO_LOCAL_S
        assert injected_s - TICK_S <= np.nanmedian(engaged["round_trip_s"]) <= injected_s + LATE_S
        true_s, reported_s = true_ages_s(engaged, rig.rows(peer))
        assert delay_s - TICK_S <= np.median(true_s) <= delay_s + LATE_S
        assert np.median(np.abs(reported_s - true_s)) < 2 * TICK_S
    assert [daemon.stop() for daemon in (local, remote)] == [0, 0]


@pytest.mark.parametrize("victim", BOTH, ids=lambda site: site.label)
def test_a_killed_site_leaves_the_other_holding_until_it_returns(rig: Rig, victim: SiteId) -> None:
    session, survivor = rig.session(), victim.peer
    daemons = {site: rig.start(site, session) for site in BOTH}
    rig.until_converged()

    daemons[victim].kill()
    rig.until_state(survivor, State.HOLD)
    held = rig.until_more(survivor, 200)
    assert (held["state"] == State.HOLD).all()
    assert np.ptp(held["peer_position_m"], axis=0).max() == 0.0
    assert error_m(held).max() < 2 * CONVERGED_M  # under gravity: the torque still regulates
    assert (np.abs(held["torque_nm"]) <= TORQUE_LIMIT_NM).all()
    assert np.abs(held["torque_nm"]).min(axis=0).max() > 1.0

    rig.start(victim, session)
    rig.until(lambda: len(rig.runs(victim)) == 2, "a second run")
    rig.until_converged()
    # the new run starts far away
    rows = rig.rows(survivor)
    assert largest_resuming_jump_n(rows) < 1.0
    assert np.isfinite(rows["torque_nm"]).all()
    survived = rows[rows["state"] != State.READY]
    assert np.isin(survived["state"], list(DRIVEN)).all()
    assert daemons[survivor].stop() == 0


@pytest.mark.parametrize(
    ("first", "then_by"),
    [(LOCAL, signal.SIGTERM), (REMOTE, signal.SIGHUP)],
    ids=["local", "remote"],
)
def test_a_site_that_is_interrupted_says_goodbye(
    rig: Rig, first: SiteId, then_by: signal.Signals
) -> None:
    # silence alone would bring HOLD after the test has given up
    session, other = rig.session(hold_after_s=f"{2 * DEADLINE_S}"), first.peer
    daemons = {site: rig.start(site, session, "--quiet") for site in BOTH}
    rig.until_engaged()
    assert daemons[first].stop(signal.SIGINT) == 0
    rig.until_state(other, State.HOLD)
    rig.until_peer_state(other, State.OFFLINE)

    last, text = rig.rows(first)[-1], daemons[first].text()
    assert f"{first.label} site ticks {last['sequence'] + 1} run, " in text  # to the last row
    assert "missed lateness p50" in text
    assert "sent, 0 dropped here" in text
    assert "Traceback" not in text
    assert daemons[other].stop(then_by) == 0
    assert f"{other.label} site ticks" in daemons[other].text()


def test_another_session_file_never_engages_and_is_told(rig: Rig) -> None:
    sessions = rig.session("ours"), rig.session("theirs", stiffness="[101.0, 100.0]")
    daemons = [rig.start(site, session) for site, session in zip(BOTH, sessions, strict=True)]

    def refused(site: SiteId) -> bool:
        rows = rig.rows(site)
        return len(rows) > 0 and rows["rejected"][-1].sum() >= 300

    rig.until(lambda: refused(LOCAL) and refused(REMOTE), "packets of another session refused")
    for site in BOTH:
        rows = rig.rows(site)
        assert (rows["state"] == State.READY).all()
        assert (rows["peer_state"] == NO_PEER_STATE).all()
        assert (rows["torque_nm"] == 0.0).all()
    for daemon in daemons:
        assert daemon.stop() == 0
        assert "ANOTHER session file" in daemon.text()


def test_another_network_profile_is_named_at_both_sites(rig: Rig) -> None:
    """In the status line, as an event, in JSON too, and in the summary."""
    profiles = {LOCAL: "lan", REMOTE: "wan"}
    sessions = {}
    for site, profile in profiles.items():
        path = rig.session(profile)
        text = path.read_text(encoding="utf-8")
        path.write_text(
            text.replace("[network]", f'[network]\nprofile = "{profile}"'), encoding="utf-8"
        )
        sessions[site] = path
    local = rig.start(LOCAL, sessions[LOCAL])
    remote = rig.start(REMOTE, sessions[REMOTE], "--log", "json")
    there = {
        LOCAL: '"wan" or "lossy", here it is "lan"',
        REMOTE: '"lan" or "wifi", here it is "wan"',
    }
    rig.until(lambda: there[LOCAL] in local.text(), "the local site tells")
    in_json = json.dumps(there[REMOTE])[1:-1]
    rig.until(lambda: in_json in remote.text(), "the remote site tells")
    assert local.stop() == 0
    assert local.text().count(there[LOCAL]) >= 2
    assert remote.stop() == 0


def test_a_suspended_site_is_held_for_and_returns_to_fresh_samples(rig: Rig) -> None:
    # a lease that outlasts the suspension: all that the peer sent meanwhile waits in the network
    session = rig.session(operator=MOVING_HAND, lease_s="10.0")
    daemons = {site: rig.start(site, session) for site in BOTH}
    rig.until_engaged()
    rig.until_more(REMOTE, 500)
    suspended_ns = time.monotonic_ns()
    daemons[REMOTE].process.send_signal(signal.SIGSTOP)
    rig.until_state(LOCAL, State.HOLD)
    rig.until_more(LOCAL, 500)
    silence_s = (time.monotonic_ns() - suspended_ns) * 1e-9
    daemons[REMOTE].process.send_signal(signal.SIGCONT)
    returned_ns = time.monotonic_ns()

    def fresh(site: SiteId) -> bool:
        row = rig.rows(site)[-1]
        engaged = row["state"] == State.ENGAGED and row["stamp_ns"] > returned_ns
        return bool(engaged and row["one_way_delay_s"] < silence_s / 2)

    rig.until(lambda: fresh(LOCAL) and fresh(REMOTE), "both ENGAGED on fresh samples")
    # the hand moved on meanwhile: what piled up is neither played back nor jumped to
    assert largest_resuming_jump_n(rig.rows(REMOTE)) < 2.0
    assert [daemon.stop() for daemon in daemons.values()] == [0, 0]


def test_a_failing_site_is_held_for_and_exits_with_one(rig: Rig) -> None:
    # no arm withstands this blow, nor does the simulation
    blow = '{ kind = "constant", force_n = [1e9, 0.0], start_s = 3.0 }'
    session = rig.session(operator=blow)
    daemons = {site: rig.start(site, session, "--quiet") for site in BOTH}
    rig.until_state(LOCAL, State.FAULT)
    rig.until_peer_state(REMOTE, State.FAULT)
    before = rig.rows(REMOTE)["state"]
    # on a crowded machine the blow may come before the remote site ever engaged
    expected = State.HOLD if State.ENGAGED in before else State.READY
    assert (rig.until_more(REMOTE, 50)["state"] == expected).all()
    stopped = rig.rows(LOCAL)
    assert (stopped["torque_nm"][stopped["state"] == State.FAULT] == 0.0).all()
    assert daemons[LOCAL].stop() == 1
    assert "FAULT DeviceError: the simulation diverged" in daemons[LOCAL].text()
    assert daemons[REMOTE].stop() == 0


def test_endpoints_on_the_command_line_replace_the_session_files(rig: Rig) -> None:
    local_endpoint, remote_endpoint = rig.local_endpoint, rig.remote_endpoint
    # the observer has this port: a site that would listen there could not start
    rig.local_endpoint = rig.remote_endpoint = rig.observer
    session = rig.session()
    rig.start_as_given(REMOTE, session, "--listen", remote_endpoint, "--connect", rig.observer)
    rig.start_as_given(
        LOCAL, session, "--listen", local_endpoint,
        "--connect", remote_endpoint, "--connect", rig.observer,
    )  # fmt: skip
    rig.until_engaged()


def test_the_session_files_endpoints_are_enough_and_the_duration_ends_a_run(rig: Rig) -> None:
    session = rig.session()
    daemons = [rig.start_as_given(site, session, "--duration", "4") for site in BOTH]
    for daemon in daemons:
        assert daemon.ended() == 0
        assert "; 0 received" not in daemon.text()


def test_what_cannot_start_says_why_and_exits_with_two(rig: Rig) -> None:
    broken = rig.session("broken", ramp_s="-1.0")
    rig.remote_endpoint = rig.observer
    taken = rig.session("taken")
    refused = [
        (rig.start(LOCAL, broken), ["local site:", "engagement.ramp_s"]),
        (rig.start(REMOTE, taken), ["remote site:", rig.observer, "in use"]),
        (rig.start(REMOTE, taken.with_name("absent.toml")), ["absent.toml"]),
    ]
    for daemon, words in refused:
        assert daemon.ended() == 2
        for word in words:
            assert word in daemon.text()
        assert "Traceback" not in daemon.text()


def test_a_signal_stops_both_sites_and_another_resets_each(rig: Rig) -> None:
    session = rig.session()
    daemons = {site: rig.start(site, session, "--quiet") for site in BOTH}
    rig.until_converged()
    daemons[LOCAL].process.send_signal(signal.SIGUSR1)
    for site in BOTH:
        rig.until_state(site, State.EMERGENCY_STOP)
        stopped = rig.until_more(site, 50)
        assert (stopped["state"] == State.EMERGENCY_STOP).all()
        assert (stopped["torque_nm"] == 0.0).all()

    # one that is reset waits for the other
    daemons[LOCAL].process.send_signal(signal.SIGUSR2)
    rig.until_state(LOCAL, State.READY)
    assert (rig.until_more(LOCAL, 100)["torque_nm"] == 0.0).all()
    assert rig.state(REMOTE) is State.EMERGENCY_STOP
    daemons[REMOTE].process.send_signal(signal.SIGUSR2)
    rig.until_converged()
    assert [daemon.stop() for daemon in daemons.values()] == [0, 0]
