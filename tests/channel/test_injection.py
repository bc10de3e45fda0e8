from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from channel.delay import (
    BurstLoss,
    ConstantDelay,
    Direction,
    Duplication,
    Reordering,
    SinusoidDelay,
    UniformDelay,
)
from channel.injection import DelayMode, Injection
from channel.packet import NO_EPOCH, NO_STAMP, Packet

MS = 1_000_000
S = 1_000_000_000


def packet(stamp_ns: int, sequence: int) -> Packet:
    zero = np.zeros(2)
    return Packet(
        0, 0, 0, 1, sequence, stamp_ns, NO_EPOCH, NO_STAMP, NO_STAMP, NO_STAMP, 0, zero, zero, zero
    )


def injection(
    direction: Direction | None, mode: DelayMode, *, start_ns: int = 0, seed: int = 1
) -> Injection:
    return Injection(direction, mode, session_start_ns=start_ns, seed=(seed,))


@dataclass
class TableDelay:
    """A delay given tick by tick: any d(t) at all."""

    delays_ms: Sequence[int]
    asked: int = 0

    @property
    def bound_s(self) -> float:
        return max(self.delays_ms) * 1e-3

    def at(self, time_s: float, rng: np.random.Generator) -> float:
        self.asked += 1
        return self.delays_ms[(self.asked - 1) % len(self.delays_ms)] * 1e-3


def newest(stamps: list[int]) -> int | None:
    return max(stamps, default=None)


spacings_ms = st.lists(st.integers(1, 30), min_size=1, max_size=60)


@settings(deadline=None)
@given(
    spacings_ms,
    st.lists(st.integers(0, 60), min_size=60, max_size=60),
    st.lists(st.integers(0, 40), min_size=1, max_size=20),
    st.integers(-(10**12), 10**12),
)
def test_exact_is_its_definition(
    spacings: list[int], network_ms: list[int], delays_ms: list[int], offset_ns: int
) -> None:
    """Any stamps, any network in order, any jumping d(t), any clock offset."""
    table = TableDelay(delays_ms)
    under_test = injection(Direction(table), "exact")  # type: ignore[arg-type]
    stamps_ms = np.cumsum(spacings).tolist()
    arrivals_ms = np.maximum.accumulate(
        [stamp + network for stamp, network in zip(stamps_ms, network_ms, strict=False)]
    ).tolist()
    targets: list[int] = []
    late = 0
    sent = list(enumerate(zip(stamps_ms, arrivals_ms, strict=True)))
    arrived: list[int] = []
    for tick, now_ms in enumerate(range(0, arrivals_ms[-1] + 50, 3)):
        while sent and sent[0][1][1] <= now_ms:
            sequence, (stamp_ms, _) = sent.pop(0)
            under_test.put(packet(stamp_ms * MS - offset_ns, sequence), now_ms * MS)
            arrived.append(stamp_ms)
            late += any(stamp_ms <= target for target in targets)
        target_ms = now_ms - delays_ms[tick % len(delays_ms)]
        targets.append(target_ms)
        expected = newest([stamp for stamp in arrived if stamp <= target_ms])
        chosen = under_test.choose(now_ms * MS, offset_ns)
        assert (chosen and (chosen.packet.stamp_ns + offset_ns) // MS) == expected
    assert under_test.late == late


@pytest.mark.parametrize("delay", [UniformDelay(0.0, 0.2), SinusoidDelay(0.1, 0.1, 5.0)])
def test_exact_stays_exact_while_it_forgets(delay: UniformDelay | SinusoidDelay) -> None:
    under_test, twin = injection(Direction(delay), "exact"), np.random.default_rng((1, 3))
    most = 0
    for tick in range(6000):
        now_ns = tick * MS
        under_test.put(packet(now_ns, tick), now_ns)
        target_ns = now_ns - round(delay.at(now_ns * 1e-9, twin) * 1e9)
        chosen = under_test.choose(now_ns, 0)
        assert (chosen and chosen.packet.stamp_ns) == (
            target_ns // MS * MS if target_ns >= 0 else None
        )
        most = max(most, len(under_test._stamps))
    assert most < 2000
    assert under_test.late == 0


def test_exact_keeps_the_last_sample_of_a_silent_peer() -> None:
    under_test = injection(Direction(ConstantDelay(0.1)), "exact")
    for tick in range(1000):
        under_test.put(packet(tick * MS, tick), tick * MS)
    for now_ns in (2 * S, 60 * S, 3600 * S):
        chosen = under_test.choose(now_ns, 0)
        assert chosen is not None
        assert chosen.packet.stamp_ns == 999 * MS


def test_a_flood_is_forgotten_not_kept() -> None:
    for mode in ("exact", "added"):
        under_test = injection(Direction(ConstantDelay(0.1)), mode)
        for k in range(20_000):
            under_test.put(packet(k, k), 0)
            under_test.choose(0, 0)
        assert len(under_test._stamps) + len(under_test._held) < 6000


def test_exact_absorbs_the_network_and_counts_what_it_cannot() -> None:
    absorbed = injection(Direction(ConstantDelay(0.1)), "exact")
    exceeded = injection(Direction(ConstantDelay(0.1)), "exact")
    for tick in range(1000):
        now_ns = tick * MS
        if tick >= 60:
            absorbed.put(packet(now_ns - 60 * MS, tick), now_ns)
        if tick >= 130:
            exceeded.put(packet(now_ns - 130 * MS, tick), now_ns)
        on_time, too_late = absorbed.choose(now_ns, 0), exceeded.choose(now_ns, 0)
    assert on_time is not None
    assert too_late is not None
    assert now_ns - on_time.packet.stamp_ns == 100 * MS
    assert now_ns - too_late.packet.stamp_ns == 130 * MS
    assert absorbed.late == 0
    assert exceeded.late == 870


def test_added_comes_on_top_of_the_network() -> None:
    under_test = injection(Direction(ConstantDelay(0.1)), "added")
    for tick in range(1000):
        now_ns = tick * MS
        if tick >= 60:
            under_test.put(packet(now_ns - 60 * MS, tick), now_ns)
        chosen = under_test.choose(now_ns, 0)
        assert (chosen is None) == (tick < 160)
    assert chosen is not None
    assert now_ns - chosen.packet.stamp_ns == 160 * MS


@settings(deadline=None)
@given(st.lists(st.integers(0, 40), min_size=1, max_size=40))
@example([1, 0])
def test_added_uses_the_newest_released(delays_ms: list[int]) -> None:
    under_test = injection(Direction(TableDelay(delays_ms)), "added")  # type: ignore[arg-type]
    overtaken = 0
    best: int | None = None
    for now_ms in range(len(delays_ms) + 50):
        if now_ms < len(delays_ms):
            under_test.put(packet(now_ms * MS, now_ms), now_ms * MS)
        released = [
            sent
            for sent in range(min(now_ms + 1, len(delays_ms)))
            if sent + delays_ms[sent] <= now_ms
        ]
        chosen = under_test.choose(now_ms * MS, 0)
        assert (chosen and chosen.packet.sequence) == newest(released)
    order = sorted(range(len(delays_ms)), key=lambda sent: (sent + delays_ms[sent], sent))
    for sent in order:
        if best is not None and sent < best:
            overtaken += 1
        best = sent if best is None else max(best, sent)
    assert under_test.overtaken == overtaken


def test_delays_run_on_session_time() -> None:
    delay = SinusoidDelay(0.1, 0.1)
    start_ns = 7 * S
    under_test = injection(Direction(delay), "exact", start_ns=start_ns)
    for tick in range(10_000):
        now_ns = tick * MS
        under_test.put(packet(now_ns, tick), now_ns)
        chosen = under_test.choose(now_ns, 0)
        age_s = delay.at((now_ns - start_ns) * 1e-9, np.random.default_rng())
        if chosen is not None:
            assert 0.0 <= (now_ns - chosen.packet.stamp_ns) * 1e-9 - age_s < 0.001 + 1e-9


def test_off_uses_the_newest_and_ignores_the_direction() -> None:
    direction = Direction(ConstantDelay(1.0), BurstLoss(1.0, 0.0), None, Duplication(1.0))
    for ignored in (direction, None):
        under_test = injection(ignored, "off")
        assert under_test.copies() == 1
        assert under_test.choose(0, 0) is None
        under_test.put(packet(5, 1), 10)
        chosen = under_test.choose(10, 0)
        assert chosen is not None
        assert chosen.packet.sequence == 1


def test_gilbert_elliott_statistics() -> None:
    loss = BurstLoss(enter_burst=0.02, leave_burst=0.25)
    under_test = injection(Direction(ConstantDelay(0.0), loss), "exact")
    lost = np.array([under_test.copies() == 0 for _ in range(200_000)])
    assert lost.mean() == pytest.approx(0.02 / 0.27, rel=0.05)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost.view(np.int8), [0]))))
    bursts = edges[1::2] - edges[::2]
    assert bursts.mean() == pytest.approx(4.0, rel=0.05)
    assert (bursts == 1).mean() == pytest.approx(0.25, rel=0.05)


def test_loss_differs_inside_and_outside_bursts() -> None:
    loss = BurstLoss(0.1, 0.1, loss_in_burst=0.5, loss_outside=0.1)
    under_test = injection(Direction(ConstantDelay(0.0), loss), "exact")
    lost = np.mean([under_test.copies() == 0 for _ in range(100_000)])
    assert lost == pytest.approx(0.3, rel=0.05)


def test_duplication_gives_two_copies() -> None:
    direction = Direction(ConstantDelay(0.0), duplication=Duplication(0.3))
    under_test = injection(direction, "exact")
    copies = [under_test.copies() for _ in range(20_000)]
    assert set(copies) == {1, 2}
    assert np.mean(copies) == pytest.approx(1.3, rel=0.02)


@pytest.mark.parametrize("mode", ["exact", "added"])
def test_reordering_holds_packets_back(mode: DelayMode) -> None:
    direction = Direction(ConstantDelay(0.01), reordering=Reordering(0.2, 0.02))
    under_test = injection(direction, mode)
    for tick in range(5000):
        now_ns = tick * MS
        under_test.put(packet(now_ns, tick), now_ns)
        chosen = under_test.choose(now_ns, 0)
        if tick >= 100:
            assert chosen is not None
            assert 10 * MS <= now_ns - chosen.packet.stamp_ns <= 30 * MS
    assert under_test.overtaken == pytest.approx(1000, rel=0.1)
    # held back beyond the exact delay, each of them missed the tick it was due at
    assert under_test.late == (under_test.overtaken if mode == "exact" else 0)


def run(seed: int, mode: DelayMode) -> list[int | None]:
    direction = Direction(
        UniformDelay(0.0, 0.05), BurstLoss(0.05, 0.3), Reordering(0.1, 0.01), Duplication(0.1)
    )
    under_test = injection(direction, mode, seed=seed)
    chosen: list[int | None] = []
    for tick in range(2000):
        if under_test.copies():
            under_test.put(packet(tick * MS, tick), tick * MS)
        sample = under_test.choose(tick * MS, 0)
        chosen.append(sample.packet.sequence if sample is not None else None)
    return chosen


@pytest.mark.parametrize("mode", ["exact", "added"])
def test_the_seed_decides_everything(mode: DelayMode) -> None:
    assert run(1, mode) == run(1, mode)
    assert run(1, mode) != run(2, mode)


def test_an_effect_leaves_the_draws_of_the_others_alone() -> None:
    loss = BurstLoss(0.1, 0.3)
    alone = injection(Direction(ConstantDelay(0.0), loss), "exact")
    along = injection(Direction(ConstantDelay(0.0), loss, None, Duplication(0.5)), "exact")
    assert [alone.copies() == 0 for _ in range(500)] == [along.copies() == 0 for _ in range(500)]


def test_clear_forgets_the_packets() -> None:
    for mode in ("exact", "added"):
        under_test = injection(Direction(ConstantDelay(0.001)), mode)
        under_test.put(packet(0, 1), 0)
        under_test.clear()
        assert under_test.choose(S, 0) is None


def test_bad_settings_are_named() -> None:
    with pytest.raises(ValueError, match="mode = 'exact' needs a direction"):
        injection(None, "exact")
    with pytest.raises(ValueError, match="mode = 'sometimes'"):
        injection(None, "sometimes")  # type: ignore[arg-type]
