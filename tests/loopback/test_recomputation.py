"""Runs computed again from what was recorded of them: bit for bit, or else it is told where not."""

from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from channel.delay import BurstLoss, Duplication, Reordering, UniformDelay
from channel.memory_link import MemoryLink
from hardware.interface import DeviceError
from site_runtime.keys import SiteId
from site_runtime.recomputation import recompute, recompute_law, whole
from site_runtime.session import ConstantOperator
from site_runtime.supervisor import State
from telemetry.recording import Recording
from tests.loopback.conftest import BUILD, Pair, both_ways, demo_session


def recording_of(pair: Pair, site: SiteId) -> Recording:
    """What the flight recorder would keep of a run that its ring holds whole."""
    ring, run = pair.sites[site].telemetry.ring, pair.sites[site]
    metadata = {
        "site": site.label,
        "digest": f"{pair.session.digest:016x}",
        "epoch": str(ring.layout.epoch),
        "wall_offset_ns": "0",
    }
    return Recording(
        run.telemetry.last(ring.layout.capacity),
        tuple(ring.events_from(0)[0]),
        ring.arrivals_from(0),
        metadata,
        pair.session.text,
        complete=True,
    )


@pytest.fixture(scope="module")
def eventful() -> Pair:
    """A run with all that a run may have: a bad network, outage, clutch, stop, resets, faults."""
    bad = both_ways(
        UniformDelay(0.01, 0.03),
        loss=BurstLoss(0.02, 0.3, 0.9),
        reordering=Reordering(0.05, 0.02),
        duplication=Duplication(0.1),
    )
    free = demo_session(bad, rate_hz=500)
    limits = replace(
        free.local.limits,
        torque_rate_nm_s=(20.0, 20.0),
        velocity_rad_s=(0.5, 0.5),
        fault_after_s=0.05,
    )
    hand = ConstantOperator("constant", (-9.0, 5.0), start_s=8.0)
    pair = Pair(replace(free, local=replace(free.local, limits=limits, operator=hand)))
    pair.run(1.0)
    local, remote = pair.local, pair.remote
    for act in (
        local.requests.toggle_clutch,
        local.requests.toggle_clutch,
        remote.requests.stop,
        remote.requests.reset,
        local.requests.reset,
    ):
        act()
        pair.run(0.6)
    assert local.state is remote.state is State.ENGAGED
    with pytest.MonkeyPatch.context() as cut:
        cut.setattr(MemoryLink, "send", lambda *_: True)
        pair.run(0.4)
    pair.links[SiteId.REMOTE].send(b"noise")
    pair.run(1.0)
    with pytest.MonkeyPatch.context() as broken:
        broken.setattr(remote._device, "read", _fails)
        pair.tick()
    pair.run(0.2)
    remote.requests.reset()
    pair.run(2.0)
    assert remote.state is State.ENGAGED
    pair.run(1.5)
    assert "GuardError" in repr(local.failure)
    return pair


def _fails() -> Any:
    raise DeviceError("cable out")


@pytest.mark.parametrize("site", SiteId)
def test_a_run_comes_out_again_bit_by_bit_whatever_happened_in_it(
    eventful: Pair, site: SiteId
) -> None:
    recording = recording_of(eventful, site)
    assert whole(recording) == ""
    told = " ".join(event.text for event in recording.events)
    assert "EMERGENCY_STOP" in told
    assert "FAULT" in told
    again = recompute(recording, eventful.session, BUILD[site])
    assert len(again.computed) == len(recording.rows) > 4000
    assert again.differing == {}
    assert {"torque_nm", "state", "cut", "offset_m", "rejected", "lost"} <= set(again.columns)


@pytest.mark.parametrize("site", SiteId)
def test_any_part_of_a_run_comes_out_again_by_the_law_alone(eventful: Pair, site: SiteId) -> None:
    recording = recording_of(eventful, site)
    part = replace(recording, rows=recording.rows[300:2500], arrivals=recording.arrivals[:0])
    assert whole(part) == "it begins with row 300"
    again = recompute_law(part, eventful.session, BUILD[site])
    assert len(again.computed) > 1000
    assert again.differing == {}


@pytest.mark.parametrize("column", ["torque_nm", "state"])
def test_one_bit_of_a_result_elsewhere_is_found_and_located(eventful: Pair, column: str) -> None:
    recording = recording_of(eventful, SiteId.LOCAL)
    rows = recording.rows.copy()
    values = rows[column].reshape(len(rows), -1)
    values.view(np.uint8)[700, 0] ^= 1
    again = recompute(replace(recording, rows=rows), eventful.session, BUILD[SiteId.LOCAL])
    assert again.differing == {column: 1}
    assert np.flatnonzero(again.differs(column)).tolist() == [700]


def test_another_reading_makes_another_torque(eventful: Pair) -> None:
    recording = recording_of(eventful, SiteId.LOCAL)
    rows = recording.rows.copy()
    assert np.isfinite(rows["engaged_s"][700])
    rows["q"][700, 1] = np.nextafter(rows["q"][700, 1], 9.0)
    again = recompute(replace(recording, rows=rows), eventful.session, BUILD[SiteId.LOCAL])
    assert np.flatnonzero(again.differs("position_m")).tolist() == [700]


def test_a_packet_that_was_another_is_found(eventful: Pair) -> None:
    recording = recording_of(eventful, SiteId.LOCAL)
    arrivals = recording.arrivals.copy()
    arrivals["data"][400, 90] ^= 1
    again = recompute(replace(recording, arrivals=arrivals), eventful.session, BUILD[SiteId.LOCAL])
    assert again.differs("rejected")[-1]
    assert not again.differs("rejected")[: arrivals["row"][400]].any()


def test_other_gains_command_other_torques_at_the_same_readings(eventful: Pair) -> None:
    session = eventful.session
    coupling = replace(session.coupling, stiffness_n_per_m=(80.0, 80.0))
    other = replace(session, coupling=coupling, digest=session.digest ^ 1)
    recording = recording_of(eventful, SiteId.REMOTE)
    again = recompute(recording, other, BUILD[SiteId.REMOTE])
    assert len(again.computed) == len(recording.rows)
    assert "torque_nm" in again.differing
    assert not {"q", "rejected", "received"} & set(again.differing)
    driven = np.isfinite(recording.rows["engaged_s"]) & (recording.rows["cut"] == 0)
    share = np.linalg.norm(again.computed["coupling_force_n"][driven], axis=1) / np.maximum(
        np.linalg.norm(again.recorded["coupling_force_n"][driven], axis=1), 1e-9
    )
    assert 0.3 < np.median(share[share > 0.0]) < 1.0


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda r: replace(r, rows=np.delete(r.rows, slice(500, 510))), "gap"),
        (lambda r: replace(r, arrivals=np.delete(r.arrivals, 500)), "arrivals are missing"),
        (lambda r: replace(r, arrivals=r.arrivals[:0]), "no arrivals"),
    ],
)
def test_what_is_not_whole_is_told(
    eventful: Pair, spoil: Callable[[Recording], Recording], why: str
) -> None:
    assert why in whole(spoil(recording_of(eventful, SiteId.LOCAL)))


def test_a_run_whose_send_rate_adapted_comes_out_again(monkeypatch: pytest.MonkeyPatch) -> None:
    free = demo_session(rate_hz=500)
    session = replace(free, channel=replace(free.channel, adapt_send_rate=True))
    pair = Pair(session)
    pair.run(1.0)
    queues: defaultdict[MemoryLink, deque[bytes]] = defaultdict(deque)
    send = MemoryLink.send

    def behind_others(link: MemoryLink, data: bytes) -> bool:
        queue = queues[link]
        queue.append(data)
        return len(queue) < 40 or send(link, queue.popleft())

    with monkeypatch.context() as slow:
        slow.setattr(MemoryLink, "send", behind_others)
        pair.run(0.4)
    pair.run(0.5)
    for site in SiteId:
        assert pair.sites[site].channel.slowed
        assert pair.sites[site].channel.send_period_ns > session.send_period_ns
        again = recompute(recording_of(pair, site), session, BUILD[site])
        assert len(again.computed) > 700
        assert again.differing == {}
