"""The sites' own code, both of it, over an in-memory link on a clock turned by hand."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from channel.channel import Channel
from channel.delay import (
    BurstLoss,
    ConstantDelay,
    Direction,
    Duplication,
    Reordering,
    SinusoidDelay,
    UniformDelay,
)
from channel.memory_link import MemoryLink, memory_links
from channel.packet import Reject
from experiments.simulation import Run, Simulation
from site_runtime.derived import derivation
from site_runtime.keys import SiteId
from site_runtime.session import (
    ChannelSettings,
    ConstantOperator,
    EnvironmentSettings,
    Session,
    WallSettings,
)
from site_runtime.supervisor import State
from telemetry.result_file import write_result
from telemetry.rows import RowArray

LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
ROUGH = {
    "loss": BurstLoss(enter_burst=0.02, leave_burst=0.2, loss_in_burst=0.9),
    "reordering": Reordering(probability=0.1, extra_s=0.01),
    "duplication": Duplication(probability=0.05),
}

MakeSession = Callable[..., Session]
MakeChannel = Callable[..., ChannelSettings]
MakePair = Callable[..., object]


def errors_m(run: Run) -> np.ndarray:
    return np.linalg.norm(run.local["position_m"] - run.remote["position_m"], axis=1)


def force_jumps_n(rows: RowArray) -> np.ndarray:
    return np.linalg.norm(np.diff(rows["coupling_force_n"], axis=0), axis=1)


@pytest.fixture
def apart(make_session: MakeSession) -> Session:
    """A session whose arms start 0.1 m apart."""
    session = make_session()
    device = replace(session.local.device, initial_position_rad=(-0.1, 1.4))
    return replace(session, local=replace(session.local, device=device))


def test_free_arms_meet_by_the_demos_gains(apart: Session) -> None:
    run = Simulation(apart).run(3.0)
    assert run.failures == ()
    error_m = errors_m(run)
    assert error_m[0] > 0.1
    assert error_m[-1] < 1e-4
    for rows in (run.local, run.remote):
        assert (rows["state"] == State.ENGAGED).all()  # from session time zero on
        assert np.abs(rows["velocity_m_s"][-1]).max() < 1e-3
        assert (rows["cut"] == 0).all()
        assert (np.diff(rows["sequence"]) == 1).all()
        assert rows["time_ns"].tolist() == list(range(0, 3_000_000_001, 1_000_000))


def test_a_wall_pushes_back_on_the_hand_as_hard_as_the_hand_pushes(
    make_session: MakeSession,
) -> None:
    session = make_session(rate_hz=500)
    push = ConstantOperator("constant", (2.5, 0.0))
    wall = WallSettings("wall", (0.46, 0.0), (-1.0, 0.0), 2000.0, 10.0)
    session = replace(
        session,
        local=replace(session.local, operator=push),
        remote=replace(session.remote, environment=EnvironmentSettings((wall,))),
    )
    run = Simulation(session).run(5.0)
    assert run.failures == ()
    local, remote = run.local[-1], run.remote[-1]
    assert remote["external_force_n"] == pytest.approx([-2.5, 0.0], abs=1e-3)
    assert local["coupling_force_n"] == pytest.approx([-2.5, 0.0], abs=1e-3)
    width = 2 * 15.0 / (np.pi * 200.0)
    stretch = width * np.tan(2.5 / (200.0 * width))
    assert local["position_m"][0] - remote["position_m"][0] == pytest.approx(stretch, abs=1e-5)


def test_both_sites_tell_the_peers_past_position(apart: Session) -> None:
    run = Simulation(apart).run(0.5)
    delay = 30
    for own, other in ((run.local, run.remote), (run.remote, run.local)):
        assert np.array_equal(own["peer_position_m"][delay:], other["position_m"][:-delay])
        assert np.allclose(own["one_way_delay_s"][delay:], 0.03)


@pytest.mark.parametrize(
    ("to_remote_s", "to_local_s"), [(0.0, 0.0), (0.03, 0.03), (0.12, 0.005), (0.0, 0.2)]
)
def test_the_measured_round_trip_is_the_sum_of_the_delays(
    make_session: MakeSession, to_remote_s: float, to_local_s: float
) -> None:
    channel = ChannelSettings(
        "exact",
        None,
        Direction(ConstantDelay(to_remote_s)),
        Direction(ConstantDelay(to_local_s)),
    )
    session = make_session(channel, rate_hz=500)
    run = Simulation(session).run(0.5)
    for rows in (run.local, run.remote):
        trip_s = rows["round_trip_s"][100:]
        assert (trip_s >= to_remote_s + to_local_s - 1e-9).all()
        assert (trip_s <= to_remote_s + to_local_s + 2 * 0.002 + 1e-9).all()


def test_the_round_trip_of_two_clocks_needs_no_synchronisation(
    make_session: MakeSession, make_pair: MakePair
) -> None:
    pair = make_pair(make_session(rate_hz=500))
    pair.run(1.0)
    for site in SiteId:
        trip_s = pair.rows(site, 0.5)["round_trip_s"]
        assert (np.abs(trip_s - 0.06) <= 2 * 0.002 + 1e-9).all()


@pytest.mark.parametrize("silent", SiteId)
def test_silence_is_held_and_recovered_from_without_a_jump(
    make_session: MakeSession, make_pair: MakePair, silent: SiteId
) -> None:
    push = ConstantOperator("constant", (2.0, 2.0), start_s=0.0)  # so that there is a way to go
    session = make_session(rate_hz=500)
    session = replace(session, local=replace(session.local, operator=push))
    pair = make_pair(session)
    pair.run(1.0)
    other = silent.peer
    # the local site ticks first, so it hears the remote one's last packet a tick later
    hold_ticks = round(session.engagement.hold_after_s * 500) + (other is LOCAL)
    pair.run(hold_ticks / 500, other)
    assert pair.sites[other].state is State.ENGAGED
    pair.tick(other)
    assert pair.sites[other].state is State.HOLD
    held = pair.rows(other, 0.002)["peer_position_m"][0].copy()
    pair.run(0.4, other)
    assert pair.sites[other].state is State.HOLD
    assert np.array_equal(pair.rows(other, 0.002)["peer_position_m"][0], held)
    pair.run(0.01)
    assert pair.sites[other].state is State.ENGAGED
    pair.run(0.5)
    assert [site.state for site in pair.sites.values()] == [State.ENGAGED, State.ENGAGED]
    assert all(site.failure is None for site in pair.sites.values())


def test_after_an_outage_the_way_made_meanwhile_is_made_up_for_without_a_jump(
    make_session: MakeSession, make_pair: MakePair, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand = ConstantOperator("constant", (-8.0, 4.0), start_s=0.5)
    session = make_session(rate_hz=500)
    pair = make_pair(replace(session, local=replace(session.local, operator=hand)))
    pair.run(0.5)
    with monkeypatch.context() as cut:
        cut.setattr(MemoryLink, "send", lambda *_: True)  # packets get lost, the hand goes on
        pair.run(0.3)
    assert [site.state for site in pair.sites.values()] == [State.HOLD, State.HOLD]
    apart_m = pair.error_m()
    assert apart_m > 0.03
    pair.run(0.5)
    assert [site.state for site in pair.sites.values()] == [State.ENGAGED, State.ENGAGED]
    for site in SiteId:
        rows = pair.rows(site, 0.5)
        targets_m = np.linalg.norm(np.diff(rows["peer_position_m"], axis=0), axis=1)
        speed_m_s = np.linalg.norm(rows["velocity_m_s"], axis=1).max()
        # the blend moves the target by at most 1.875/blend_s of the way, while the peer moves on
        way_m = apart_m + speed_m_s * session.engagement.blend_s
        rate_m_s = 1.875 / session.engagement.blend_s * way_m + speed_m_s
        assert targets_m.max() < 1.1 * rate_m_s / 500
        assert force_jumps_n(rows).max() < 200.0 * 1.1 * (rate_m_s + speed_m_s) / 500
        assert 1.1 * (rate_m_s + speed_m_s) / 500 < apart_m / 5  # at once, it would be all of it


def test_another_session_at_the_other_end_never_engages(
    make_session: MakeSession, make_pair: MakePair
) -> None:
    session = make_session(rate_hz=250)
    pair = make_pair(session, remote_session=replace(session, digest=session.digest ^ 1))
    pair.run(1.0)
    for site in pair.sites.values():
        assert site.state is State.READY
        assert site.channel.other_session is not None
        assert not pair.rows(site.identity, 1.0)["torque_nm"].any()


@pytest.mark.parametrize("dead_s", [0.01, 0.2])
@pytest.mark.parametrize("restarted", SiteId)
def test_a_site_started_anew_is_taken_back_without_a_jump(
    make_session: MakeSession, make_pair: MakePair, restarted: SiteId, dead_s: float
) -> None:
    session = make_session(rate_hz=500)
    device = replace(session.local.device, initial_position_rad=(-0.1, 1.4))
    session = replace(session, local=replace(session.local, device=device))
    pair = make_pair(session)
    pair.run(2.0)
    assert pair.error_m() < 0.02
    before_m = pair.rows(restarted, 0.002)["position_m"][0].copy()
    other = restarted.peer
    pair.run(dead_s, other)
    pair.start(restarted, epoch=9)
    pair.tick()
    moved_m = np.linalg.norm(pair.rows(restarted, 0.002)["position_m"][0] - before_m)
    assert moved_m > 0.05  # the new run's robot stands elsewhere
    states = set()
    for _ in range(1000):
        pair.tick()
        states.add(pair.sites[other].state)
    assert states == {State.HOLD, State.ENGAGED}
    assert pair.sites[other].channel.counters.peer_restarts == 1
    assert [site.state for site in pair.sites.values()] == [State.ENGAGED, State.ENGAGED]
    jump_n = force_jumps_n(pair.rows(other, 2.0 + dead_s)).max()
    assert jump_n < 200.0 * moved_m * 1.875 / session.engagement.blend_s / 500 * 1.5
    assert pair.error_m() < 0.02


def test_a_recording_does_not_take_the_place_of_a_peer_that_speaks(
    make_session: MakeSession, make_pair: MakePair
) -> None:
    pair = make_pair(make_session(rate_hz=500))
    pair.run(1.0)
    recorder, recorded = memory_links()
    earlier = Channel(
        recorder,
        site=REMOTE,
        session_digest=pair.session.digest,
        epoch=7,
        dimension=2,
        send_period_ns=pair.session.send_period_ns,
        silence_ns=1,
        session_start_ns=0,
    )
    elsewhere, rest = np.array([0.2, -0.3]), np.zeros(2)
    for _ in range(100):
        earlier.send(pair.clock.now_ns(), State.ENGAGED, elsewhere, rest, rest)
        for data in recorded.receive():
            pair.links[REMOTE].send(data)
        pair.tick()
        assert pair.local.state is State.ENGAGED
    assert pair.local.channel.counters.rejected[Reject.EPOCH] == 100
    assert np.abs(pair.rows(LOCAL, 0.2)["peer_position_m"] - elsewhere).min() > 0.05


def test_a_clean_end_of_one_site_is_held_by_the_other(
    make_session: MakeSession, make_pair: MakePair
) -> None:
    pair = make_pair(make_session(rate_hz=500))
    pair.run(0.5)
    pair.remote.close()
    pair.tick(LOCAL)
    assert pair.local.state is State.HOLD
    assert pair.local.channel.heard_state == State.OFFLINE


def test_a_fault_of_one_site_is_held_by_the_other_and_shown(
    make_session: MakeSession, make_pair: MakePair
) -> None:
    pair = make_pair(make_session(rate_hz=500))
    pair.run(0.5)
    pair.remote._device.close()  # reading a closed device fails
    pair.run(0.01)
    assert pair.remote.state is State.FAULT
    assert pair.local.state is State.HOLD
    row = pair.rows(REMOTE, 0.002)[0]
    assert row["state"] == State.FAULT
    assert not row["torque_nm"].any()
    pair.run(0.5)
    assert (pair.remote.state, pair.local.state) == (State.FAULT, State.HOLD)


@pytest.mark.parametrize(
    "delay", [UniformDelay(0.0, 0.06), SinusoidDelay(0.03, 0.03, 5.0)], ids=["jitter", "sinusoid"]
)
@pytest.mark.parametrize("mode", ["exact", "added"])
def test_loss_jitter_and_reordering_leave_it_bounded_and_converging(
    apart: Session, make_channel: MakeChannel, delay: UniformDelay | SinusoidDelay, mode: str
) -> None:
    channel = replace(make_channel(delay, **ROUGH), injection=mode)
    simulation = Simulation(replace(apart, channel=channel))
    run = simulation.run(3.5)
    assert run.failures == ()
    error_m = errors_m(run)
    assert error_m.max() < 1.2 * error_m[0]
    assert error_m[-1] < 1e-3
    for site in (simulation.local, simulation.remote):
        assert site.channel.counters.lost_injected > 100
        assert site.channel.counters.overtaken > 10


@pytest.mark.parametrize("random", ["network", "encoder"])
def test_the_same_seed_gives_the_same_bits_and_another_does_not(
    apart: Session, make_channel: MakeChannel, tmp_path: Path, random: str
) -> None:
    session = replace(apart, channel=make_channel(UniformDelay(0.0, 0.05), **ROUGH))
    if random == "encoder":
        noisy = replace(apart.local.device, velocity_noise_rad_s=0.01)
        session = replace(apart, local=replace(apart.local, device=noisy))
    files = [tmp_path / name for name in ("one.parquet", "two.parquet", "other.parquet")]
    runs = []
    for file, seed in zip(files, (1, 1, 2), strict=True):
        run = Simulation(replace(session, seed=seed)).run(0.4)
        write_result(file, run.local, run.remote, {"session": session.text}, derivation(session))
        runs.append(run)
    one, two, other = runs
    assert one.local.tobytes() == two.local.tobytes()
    assert one.remote.tobytes() == two.remote.tobytes()
    assert files[0].read_bytes() == files[1].read_bytes()
    assert one.local.tobytes() != other.local.tobytes()
    assert one.remote.tobytes() != other.remote.tobytes()


def test_the_seed_changes_nothing_where_nothing_is_random(apart: Session) -> None:
    one, other = (Simulation(replace(apart, seed=seed)).run(0.3) for seed in (1, 2))
    assert one.remote.tobytes() == other.remote.tobytes()


def test_a_simulation_ends_where_a_site_fails(apart: Session) -> None:
    simulation = Simulation(apart)
    step = simulation.remote._controller.step

    def fails_later(*arguments: object) -> object:
        if simulation.remote.ticks > 555:
            raise ArithmeticError("the controller broke")
        return step(*arguments)

    object.__setattr__(
        simulation.remote, "_controller", type("Broken", (), {"step": staticmethod(fails_later)})
    )
    run = simulation.run(2.0)
    assert run.failures == ("remote: ArithmeticError: the controller broke",)
    assert 300 < len(run.local) == len(run.remote) < 555
    assert run.remote["sequence"][-1] == 555  # the last before the tick that failed
    assert np.array_equal(run.local["time_ns"], run.remote["time_ns"])


def test_a_site_that_fails_at_time_zero_leaves_no_row_but_its_reason(
    apart: Session,
) -> None:
    straight = replace(apart.remote.device, initial_position_rad=(0.0, 0.0, 0.0))
    exact = replace(apart.remote.null_space, regularisation=0.0)  # (4) as printed: no value here
    session = replace(apart, remote=replace(apart.remote, device=straight, null_space=exact))
    run = Simulation(session).run(1.0)
    assert run.failures == ("remote: ZeroDivisionError: float division by zero",)
    assert len(run.local) == len(run.remote) == 0


def test_progress_is_told_in_session_time(apart: Session) -> None:
    told: list[float] = []
    run = Simulation(apart).run(0.5, told.append)
    assert told == sorted(told)
    assert told[0] == 0.0
    assert 0.4 < told[-1] <= 0.5
    assert run.local["time_ns"][[0, -1]].tolist() == [0, 500_000_000]
