from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from channel.channel import Channel, PeerSample
from channel.delay import (
    BurstLoss,
    ConstantDelay,
    Direction,
    Duplication,
    Reordering,
    SinusoidDelay,
    UniformDelay,
)
from channel.injection import DelayMode
from channel.memory_link import MemoryLink, memory_links
from channel.packet import NO_AGE, Reject, encode

MS = 1_000_000
S = 1_000_000_000
ZERO = np.zeros(2)


def channel(link: MemoryLink, site: int, **changes: Any) -> Channel:
    settings: dict[str, Any] = {
        "session_digest": 77,
        "epoch": 1000 + site,
        "dimension": 2,
        "send_period_ns": MS,
        "silence_ns": 50 * MS,
        "session_start_ns": 0,
    }
    return Channel(link, site=site, **(settings | changes))


def pair(**changes: Any) -> tuple[Channel, Channel]:
    links = memory_links()
    return channel(links[0], 0, **changes), channel(links[1], 1, **changes)


def tick(site: Channel, now_ns: int, state: int = 2) -> PeerSample | None:
    sample = site.latest(now_ns)
    site.send(now_ns, state, ZERO, ZERO, ZERO)
    return sample


class Wire:
    """A hand-held peer: site 1 as the tests want it, against a real channel at site 0."""

    def __init__(self, **changes: Any) -> None:
        self.link, own = memory_links()
        self.channel = channel(own, 0, **changes)

    def packet(self, sequence: int = 1, **changes: Any) -> bytes:
        fields: dict[str, Any] = {
            "site": 1,
            "state": 2,
            "session": 77,
            "epoch": 1001,
            "sequence": sequence,
            "stamp_ns": sequence * MS,
            "echo_epoch": 1000,
            "echo_stamp_ns": 0,
            "echo_arrival_ns": 0,
            "used_stamp_ns": 0,
            "greatest_age_ns": 0,
            "vectors": np.zeros((3, 2)),
        }
        return encode(**(fields | changes))

    def hear(self, now_ns: int, *packets: bytes) -> PeerSample | None:
        for data in packets:
            self.link.send(data)
        return self.channel.latest(now_ns)

    @property
    def rejected(self) -> dict[Reject, int]:
        return dict(self.channel.counters.rejected)


def test_what_is_sent_is_what_is_used() -> None:
    local, remote = pair(shared_clock=True)
    position, velocity, force = np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([5.0, 6.0])
    assert local.send(5 * MS, 3, position, velocity, force)
    sample = remote.latest(6 * MS)
    assert sample is not None
    np.testing.assert_array_equal(sample.position_m, position)
    np.testing.assert_array_equal(sample.velocity_m_s, velocity)
    np.testing.assert_array_equal(sample.force_n, force)
    assert (sample.state, sample.stamp_ns, sample.sequence) == (3, 5 * MS, 1)
    assert sample.age_ns == MS
    assert sample.round_trip_ns is None, "local was using no sample of remote's"


def test_nothing_is_used_before_the_peer_has_answered() -> None:
    local, remote = pair()
    assert tick(local, 0) is None
    assert tick(remote, 0) is None
    assert not remote.peer_confirmed
    assert remote.heard_ns == 0
    assert tick(local, MS) is not None
    assert local.peer_confirmed
    assert tick(remote, MS) is not None
    assert remote.peer_confirmed


def test_a_sample_tells_when_it_arrived_however_long_it_has_been_in_use() -> None:
    wire = Wire()
    for now_ms in (7, 8, 20):
        sample = wire.hear(now_ms * MS, *([wire.packet()] if now_ms == 7 else []))
        assert sample is not None
        assert sample.arrival_ns == 7 * MS


@pytest.mark.parametrize("mode", ["exact", "added"])
@pytest.mark.parametrize("shared_clock", [True, False])
def test_round_trip_is_the_sum_of_the_delays(mode: DelayMode, shared_clock: bool) -> None:
    links = memory_links()
    settings: dict[str, Any] = {"mode": mode, "shared_clock": shared_clock}
    local = channel(links[0], 0, direction=Direction(ConstantDelay(0.12)), **settings)
    remote = channel(links[1], 1, direction=Direction(ConstantDelay(0.05)), **settings)
    for k in range(1000):
        at_local, at_remote = tick(local, k * MS), tick(remote, k * MS)
    exact = shared_clock and mode == "exact"
    for sample in (at_local, at_remote):
        assert sample is not None
        assert sample.round_trip_ns is not None
        # local ticks first, so what comes back to it waits for its next tick
        assert 170 * MS <= sample.round_trip_ns <= (170 if exact else 171) * MS
    assert at_local is not None
    assert at_remote is not None
    tolerance_ns = 0 if exact else MS
    assert abs(at_local.age_ns - 120 * MS) <= tolerance_ns
    assert abs(at_remote.age_ns - 50 * MS) <= tolerance_ns


def test_round_trip_follows_a_varying_delay_without_a_common_clock() -> None:
    """Clocks days apart; the paper's d(t) one way; the network takes 3 ms each way."""
    ahead_ns = 3 * 86_400 * S
    network_ms = 3
    forth, back = memory_links(), memory_links()
    delay = SinusoidDelay(0.1, 0.1)
    local = channel(forth[0], 0, direction=Direction(ConstantDelay(0.05)), mode="exact")
    remote = channel(
        back[0], 1, direction=Direction(delay), mode="exact", session_start_ns=ahead_ns
    )
    in_flight: list[tuple[int, MemoryLink, bytes]] = []
    rng = np.random.default_rng()
    for k in range(8000):
        for arrival_ms, link, data in in_flight:
            if arrival_ms <= k:
                link.send(data)
        in_flight = [flight for flight in in_flight if flight[0] > k]
        at_local = tick(local, k * MS)
        at_remote = tick(remote, k * MS + ahead_ns)
        in_flight += [(k + network_ms, back[1], data) for data in forth[1].receive()]
        in_flight += [(k + network_ms, forth[1], data) for data in back[1].receive()]
        if k > 1000:
            assert at_local is not None
            assert at_remote is not None
            assert at_local.round_trip_ns is not None
            d_l = max(delay.at((k - 50) * 1e-3, rng), network_ms * 1e-3)
            assert abs(at_local.round_trip_ns - (d_l + 0.05) * 1e9) < 2.1 * MS
            expected = max(delay.at(k * 1e-3, rng), network_ms * 1e-3)
            assert abs(at_remote.age_ns - expected * 1e9) < 1.1 * MS
    assert local.offset is not None
    assert abs(local.offset.offset_ns + ahead_ns) <= local.offset.uncertainty_ns


def test_loop_bound_is_the_sum_of_the_greatest_ages_whatever_the_clocks() -> None:
    """Delays in opposite phase: no loop is ever as old as the two greatest ages together."""
    ahead_ns = 3 * 86_400 * S
    links = memory_links()
    forth = SinusoidDelay(0.1, 0.08, angular_frequency_rad_s=12.0)
    back = SinusoidDelay(0.1, 0.08, angular_frequency_rad_s=12.0, phase_rad=np.pi)
    local = channel(links[0], 0, direction=Direction(forth), mode="exact")
    remote = channel(
        links[1], 1, direction=Direction(back), mode="exact", session_start_ns=ahead_ns
    )
    assert local.loop_bound_ns is None
    oldest_ns = 0
    for k in range(4000):
        at_local = tick(local, k * MS)
        tick(remote, k * MS + ahead_ns)
        if k > 2000:
            assert at_local is not None
            assert at_local.round_trip_ns is not None
            oldest_ns = max(oldest_ns, at_local.round_trip_ns)
            for site in (local, remote):
                assert site.loop_bound_ns is not None
                assert abs(site.loop_bound_ns - 360 * MS) <= 3 * MS
    assert oldest_ns < 345 * MS, "the loop's age at one moment does not show the bound"


def test_loop_bound_holds_the_greatest_age_for_a_while_then_forgets_it() -> None:
    wire = Wire()
    wire.hear(1 * MS, wire.packet(1, greatest_age_ns=7 * MS))
    wire.hear(200 * MS)
    assert wire.channel.loop_bound_ns == (199 + 7) * MS
    for k in range(201, 1500):
        wire.hear(k * MS, wire.packet(k, greatest_age_ns=5 * MS))
        if k == 600:
            assert wire.channel.loop_bound_ns == (199 + 5) * MS
    assert wire.channel.loop_bound_ns == 5 * MS


def test_loop_bound_is_unknown_until_both_use_samples_of_this_run() -> None:
    wire = Wire()
    assert wire.channel.loop_bound_ns is None
    wire.hear(1 * MS, wire.packet(1, greatest_age_ns=NO_AGE))
    assert wire.channel.loop_bound_ns is None
    wire.hear(2 * MS, wire.packet(2, echo_epoch=999))
    assert wire.channel.loop_bound_ns is None
    assert wire.channel.peer_taken
    wire.hear(3 * MS, wire.packet(3))
    assert wire.channel.loop_bound_ns == 0
    assert not wire.channel.peer_taken


def test_round_trip_counts_the_spacing_and_the_hold() -> None:
    local, remote = pair(send_period_ns=10 * MS, shared_clock=True)
    ages = []
    for k in range(300):
        at_local = tick(local, k * MS)
        tick(remote, k * MS)
        if k > 100:
            assert at_local is not None
            assert at_local.round_trip_ns is not None
            ages.append(at_local.round_trip_ns)
    assert min(ages) == 1 * MS, "both send at the same ticks: just arrived"
    assert max(ages) == 10 * MS, "held until the next packet"
    assert local.counters.sent == 30
    held = local.latest(10 * S)
    assert held is not None
    assert held.round_trip_ns is not None
    assert held.round_trip_ns > 9 * S, "a silent peer's sample ages"
    assert held.age_ns > 9 * S


@pytest.mark.parametrize(
    ("period_ms", "sent"), [(0, 1000), (0.5, 1000), (1, 1000), (2, 500), (4, 250), (2.5, 400)]
)
@pytest.mark.parametrize("jitter_ms", [0.0, 0.3])
def test_send_keeps_its_rate(period_ms: float, sent: int, jitter_ms: float) -> None:
    local, _ = pair(send_period_ns=round(period_ms * MS))
    rng = np.random.default_rng(3)
    for k in range(1000):
        now_ns = k * MS + round(rng.uniform(0, jitter_ms) * MS)
        local.send(now_ns, 2, ZERO, ZERO, ZERO)
    assert local.counters.sent == pytest.approx(sent, rel=0.005)


def test_jitter_does_not_move_a_packet_to_another_tick() -> None:
    local, _ = pair(send_period_ns=4 * MS)
    rng = np.random.default_rng(3)
    sent = [
        k
        for k in range(1000)
        if local.send(k * MS + round(rng.uniform(0.0, 0.2) * MS), 2, ZERO, ZERO, ZERO)
    ]
    assert sent == list(range(0, 1000, 4))


def test_send_does_not_catch_up_after_a_stall() -> None:
    local, remote = pair(send_period_ns=4 * MS)
    for k in [*range(100), *range(1000, 1100)]:
        local.send(k * MS, 2, ZERO, ZERO, ZERO)
    assert local.counters.sent <= 51
    remote.latest(2 * S)
    assert remote.counters.lost == 0, "what was never due is not lost"


def test_a_dropped_send_is_counted_here_and_lost_there() -> None:
    wire = Wire()
    wire.link.close()
    assert not wire.channel.send(0, 2, ZERO, ZERO, ZERO)
    assert wire.channel.counters.send_dropped == 1
    assert wire.channel.counters.sent == 0


def test_send_refuses_a_vector_of_another_dimension() -> None:
    with pytest.raises(ValueError, match="shape"):
        Wire().channel.send(0, 2, np.zeros(3), ZERO, ZERO)


@pytest.mark.parametrize(
    ("reason", "data"),
    [
        (Reject.LENGTH, lambda wire: b"short"),
        (Reject.MAGIC, lambda wire: b"NOPE" + wire.packet()[4:]),
        (Reject.VERSION, lambda wire: b"FARH\x63" + wire.packet()[5:]),
        (Reject.CHECKSUM, lambda wire: wire.packet()[:-1] + b"\0"),
        (Reject.NON_FINITE, lambda wire: wire.packet(7, vectors=np.full((3, 2), np.nan))),
        (Reject.DIMENSION, lambda wire: wire.packet(7, vectors=np.zeros((3, 3)))),
        (Reject.SITE, lambda wire: wire.packet(7, site=0)),
        (Reject.SITE, lambda wire: wire.packet(7, site=9)),
        (Reject.SESSION, lambda wire: wire.packet(7, session=78)),
        (Reject.EPOCH, lambda wire: wire.packet(7, epoch=999)),
        (Reject.DUPLICATE, lambda wire: wire.packet(5)),
        (Reject.OUT_OF_ORDER, lambda wire: wire.packet(4)),
        (Reject.STAMP, lambda wire: wire.packet(7, stamp_ns=5 * MS)),
    ],
)
def test_what_is_wrong_is_counted_and_ignored(
    reason: Reject, data: Callable[[Wire], bytes]
) -> None:
    wire = Wire()
    before = wire.hear(10 * MS, wire.packet(5))
    after = wire.hear(11 * MS, data(wire))
    assert wire.rejected == {reason: 1}
    assert before is not None
    assert after is not None
    assert after.sequence == 5
    assert wire.channel.heard_ns == 10 * MS
    assert wire.channel.counters.received == 1
    assert wire.hear(12 * MS, wire.packet(6)) is not None
    assert wire.channel.counters.received == 2


def test_every_reason_can_be_reached() -> None:
    marks = test_what_is_wrong_is_counted_and_ignored.pytestmark  # type: ignore[attr-defined]
    assert {case[0] for case in marks[0].args[1]} == set(Reject)


def test_a_wrong_first_packet_is_no_peer() -> None:
    wire = Wire()
    assert wire.hear(0, wire.packet(session=78), wire.packet(vectors=np.zeros((3, 3)))) is None
    assert wire.channel.heard_ns is None
    assert wire.channel.heard_state is None
    assert not wire.channel.peer_confirmed


def test_another_session_is_shown_for_a_second() -> None:
    wire = Wire()
    assert wire.channel.other_session is None
    wire.hear(10 * MS, wire.packet(session=78))
    assert wire.channel.other_session == 78
    wire.hear(999 * MS)
    assert wire.channel.other_session == 78
    wire.hear(1010 * MS)
    assert wire.channel.other_session is None


def test_sequence_gaps_are_losses() -> None:
    wire = Wire()
    wire.hear(0, wire.packet(10), wire.packet(11), wire.packet(15), wire.packet(16))
    assert wire.channel.counters.lost == 3
    assert wire.channel.counters.received == 4


def test_state_is_of_the_sample_in_use_and_heard_state_of_the_newest() -> None:
    wire = Wire(direction=Direction(ConstantDelay(0.1)), mode="exact", shared_clock=True)
    wire.hear(10 * MS, wire.packet(10, state=1))
    sample = wire.hear(110 * MS, wire.packet(100, state=3))
    assert sample is not None
    assert sample.state == 1
    assert wire.channel.heard_state == 3


def test_a_restarted_peer_is_accepted_after_the_silence() -> None:
    wire = Wire()
    wire.hear(10 * MS, wire.packet(500))
    wire.hear(59 * MS, wire.packet(1, epoch=2000))
    assert wire.rejected == {Reject.EPOCH: 1}
    later_ns = 60 * MS
    fresh = wire.packet(2, epoch=2000, echo_stamp_ns=59 * MS, echo_arrival_ns=MS)
    sample = wire.hear(later_ns, fresh)
    assert sample is not None
    assert sample.sequence == 2
    assert wire.channel.counters.peer_restarts == 1
    assert wire.channel.counters.lost == 0
    offset = wire.channel.offset
    assert offset is not None
    assert abs(offset.offset_ns - 58 * MS) <= offset.uncertainty_ns, "the new run's clock"
    wire.hear(61 * MS, wire.packet(501))
    assert wire.rejected == {Reject.EPOCH: 2}, "the old run does not come back"


def test_a_run_that_was_replaced_may_be_welcomed_back() -> None:
    """As when a robot is handed over and back."""
    wire = Wire()
    wire.hear(10 * MS, wire.packet(500))
    wire.hear(80 * MS, wire.packet(1, epoch=2000, echo_stamp_ns=59 * MS, echo_arrival_ns=MS))
    wire.channel.welcome_back()
    wire.hear(81 * MS, wire.packet(501))
    assert wire.rejected == {Reject.EPOCH: 1}, "not while the new one is heard"
    wire.hear(200 * MS, wire.packet(502))
    assert wire.rejected == {Reject.EPOCH: 1}
    assert wire.channel.counters.peer_restarts == 2


def test_a_restarted_peer_is_used_once_it_answers() -> None:
    wire = Wire()
    assert wire.hear(10 * MS, wire.packet(500, stamp_ns=MS)) is not None
    unaware = wire.packet(1, epoch=2000, echo_epoch=0, stamp_ns=2 * MS)
    assert wire.hear(S, unaware) is None
    assert wire.channel.offset is None


def test_no_sample_of_a_former_run_is_used() -> None:
    wire = Wire(direction=Direction(ConstantDelay(0.1)), mode="exact")
    wire.hear(10 * MS, wire.packet(1))
    assert wire.hear(200 * MS) is not None
    fresh = wire.packet(1, epoch=2000, echo_stamp_ns=S, echo_arrival_ns=0, stamp_ns=0)
    assert wire.hear(S, fresh) is None, "the new run's first is not due yet"
    sample = wire.hear(S + 101 * MS)
    assert sample is not None
    assert sample.stamp_ns == 0


def recording(seconds: int) -> list[bytes]:
    """Record what a remote site says to its local peer in another, confirmed run."""
    links = memory_links()
    local, remote = channel(links[0], 0, epoch=5), channel(links[1], 1, epoch=6)
    tape: list[bytes] = []
    for k in range(seconds * 1000):
        tick(local, k * MS)
        tick(remote, k * MS)
        heard = links[0].receive()
        tape += heard
        for data in heard:
            links[1].send(data)
    assert remote.peer_confirmed
    return tape


def test_a_recording_never_confirms_and_is_never_used() -> None:
    wire = Wire()
    for k, data in enumerate(recording(1)):
        wire.channel.send(k * MS, 2, ZERO, ZERO, ZERO)
        assert wire.hear(k * MS, data) is None
        assert not wire.channel.peer_confirmed
    assert wire.channel.counters.received == 1000


def test_a_recording_heard_first_gives_way_to_a_live_peer() -> None:
    wire = Wire()
    tape = recording(1)
    for k in range(100):
        wire.hear(k * MS, tape[k])
    wire.hear(100 * MS, tape[100], wire.packet(1, epoch=9, echo_epoch=0))
    assert wire.rejected == {Reject.EPOCH: 1}, "it does not answer me yet"
    assert wire.hear(101 * MS, tape[101], wire.packet(2, epoch=9)) is not None
    assert wire.channel.peer_confirmed
    wire.hear(102 * MS, tape[102])
    assert wire.channel.peer_confirmed
    assert wire.rejected == {Reject.EPOCH: 2}


def test_an_answer_to_my_former_run_has_no_round_trip() -> None:
    wire = Wire(shared_clock=True)
    sample = wire.hear(10 * MS, wire.packet(1, echo_epoch=999, used_stamp_ns=5 * MS))
    assert sample is not None
    assert sample.round_trip_ns is None
    assert not wire.channel.peer_confirmed


def test_injected_copies_meet_the_production_check() -> None:
    direction = Direction(ConstantDelay(0.0), duplication=Duplication(1.0))
    wire = Wire(direction=direction, mode="exact")
    wire.hear(0, *(wire.packet(k) for k in range(1, 51)))
    assert wire.rejected == {Reject.DUPLICATE: 50}
    assert wire.channel.counters.received == 50


def test_injected_loss_looks_like_loss() -> None:
    direction = Direction(ConstantDelay(0.0), BurstLoss(0.1, 0.4))
    wire = Wire(direction=direction, mode="exact")
    for k in range(1, 5001):
        wire.hear(k * MS, wire.packet(k))
    counters = wire.channel.counters
    assert counters.lost_injected == pytest.approx(1000, rel=0.25)
    assert counters.received == 5000 - counters.lost_injected
    assert abs(counters.lost - counters.lost_injected) < 30, "but for the ends"
    silent = Wire(direction=Direction(ConstantDelay(0.0), BurstLoss(1.0, 0.0)), mode="exact")
    silent.hear(0, silent.packet(1))
    assert silent.channel.heard_ns is None


def test_a_seeded_run_repeats_itself() -> None:
    def run() -> list[int | None]:
        direction = Direction(
            UniformDelay(0.0, 0.1), BurstLoss(0.02, 0.3), Reordering(0.1, 0.02), Duplication(0.1)
        )
        local, remote = pair(direction=direction, mode="exact", seed=11)
        used: list[int | None] = []
        for k in range(1500):
            for site in (local, remote):
                sample = tick(site, k * MS)
                used.append(None if sample is None else sample.sequence)
        return used

    assert run() == run()


def test_one_seed_gives_each_site_its_own_draws() -> None:
    def heard(site: int, seed: int) -> list[int]:
        sender, own = memory_links()
        direction = Direction(ConstantDelay(0.0), BurstLoss(0.5, 0.5))
        far = channel(sender, 1 - site)
        near = channel(own, site, direction=direction, mode="exact", seed=seed)
        received = []
        for k in range(200):
            tick(far, k * MS)
            tick(near, k * MS)
            received.append(near.counters.received)
        return received

    assert heard(0, 5) == heard(0, 5)
    assert heard(0, 5) != heard(1, 5)
    assert heard(0, 5) != heard(0, 6)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("site", 2),
        ("epoch", 0),
        ("epoch", 2**64),
        ("session_digest", -1),
        ("dimension", 4),
        ("send_period_ns", -1),
        ("silence_ns", 0),
    ],
)
def test_bad_settings_are_named(key: str, value: int) -> None:
    with pytest.raises(ValueError, match=f"{key} = {value}"):
        channel(memory_links()[0], **({"site": 0} | {key: value}))


def test_offset_is_unknown_until_there_is_an_exchange() -> None:
    wire = Wire()
    assert wire.channel.offset is None
    assert wire.channel.one_way_ns is None
    wire.hear(0, wire.packet(1, echo_epoch=0))
    assert wire.channel.offset is None
    assert wire.channel.one_way_ns is None


def test_a_run_that_gave_way_to_a_live_one_is_never_heard_again() -> None:
    wire = Wire()
    wire.hear(1 * MS, wire.packet(1))
    wire.hear(100 * MS, wire.packet(1, epoch=1002, stamp_ns=100 * MS))
    assert wire.channel.counters.peer_restarts == 1
    wire.hear(300 * MS, wire.packet(2, stamp_ns=2 * MS))
    assert wire.channel.heard_ns == 100 * MS
    assert wire.rejected == {Reject.EPOCH: 1}
    wire.hear(400 * MS, wire.packet(1, epoch=1003, stamp_ns=400 * MS))
    assert wire.channel.counters.peer_restarts == 2, "a new run is another matter"


def test_a_live_run_is_not_given_up_for_a_recording_heard_in_its_silence() -> None:
    wire = Wire()
    wire.hear(1 * MS, wire.packet(1))
    wire.hear(100 * MS, wire.packet(1, epoch=7, echo_epoch=999))
    wire.hear(101 * MS, wire.packet(2, stamp_ns=101 * MS))
    assert wire.channel.peer_confirmed
    assert wire.channel.heard_ns == 101 * MS
