"""One site, its ticks called by hand, against a peer that is a channel alone."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, nan

import numpy as np
import numpy.typing as npt
import pytest

from channel.channel import Channel, PeerSample
from channel.memory_link import MemoryLink, memory_links
from channel.packet import Packet, Reject
from hardware.interface import DeviceError, DeviceState, JointStops
from hardware.robot_model import PlanarArm, RobotModel, RobotTerms, build_robot
from site_runtime.clock import ManualClock
from site_runtime.controller import Command
from site_runtime.guard import Cut, Guard, GuardError, Limits
from site_runtime.keys import SiteId
from site_runtime.margin import Margin
from site_runtime.operator_requests import (
    CLUTCH,
    CLUTCH_BUTTON,
    EMERGENCY_STOP,
    RESET,
    UNLEASED,
    OperatorRequests,
)
from site_runtime.site import LateError, Site, SiteTimes
from site_runtime.supervisor import EngagementRules, State, Supervisor
from telemetry.rows import NO_PEER_STATE, REJECT_REASONS
from telemetry.stream import TelemetryStream, decode_batch

FloatArray = npt.NDArray[np.float64]
MS = 1_000_000
DIGEST, EPOCH, PEER_EPOCH = 11, 21, 22
HOLD_AFTER, STOP_AFTER = 20 * MS, 200 * MS
CERTIFIED_S = 0.4
LATE_HOLD, LATE_FAULT = 5, 20
Q = np.array([0.3, 0.8])


@dataclass
class Journal:
    """What was called, in order; a name in `trouble` raises when it is called."""

    calls: list[str] = field(default_factory=list)
    trouble: dict[str, BaseException] = field(default_factory=dict)

    def note(self, name: str) -> None:
        self.calls.append(name)
        if name in self.trouble:
            raise self.trouble[name]

    def count(self, name: str) -> int:
        return self.calls.count(name)


@dataclass
class FakeDevice:
    journal: Journal
    clock: ManualClock
    joints: int = 2
    joint_stops: JointStops = field(default_factory=lambda: JointStops.none(2))
    clutch: bool = False
    wrench: FloatArray = field(default_factory=lambda: np.arange(1.0, 7.0))
    position: FloatArray = field(default_factory=lambda: Q)
    velocity: FloatArray = field(default_factory=lambda: np.array([0.1, -0.2]))
    written: list[FloatArray] = field(default_factory=list)

    def open(self) -> None:
        self.journal.note("open")

    def enable(self) -> None:
        self.journal.note("enable")

    def read(self) -> DeviceState:
        self.journal.note("read")
        return DeviceState(
            self.position.copy(),
            self.velocity.copy(),
            self.wrench.copy(),
            self.clock.now_ns(),
            self.clutch,
        )

    def write(self, torque_nm: FloatArray) -> None:
        self.journal.note("write")
        self.written.append(torque_nm.copy())

    def stop(self) -> None:
        self.journal.calls.append("stop")  # never raises

    def close(self) -> None:
        self.journal.note("close")


class NotedRobot:
    def __init__(self, model: RobotModel, journal: Journal) -> None:
        self._model, self._journal = model, journal
        self.joints, self.task_dimension = model.joints, model.task_dimension

    def terms(self, q: FloatArray, q_dot: FloatArray) -> RobotTerms:
        self._journal.note("terms")
        return self._model.terms(q, q_dot)


class NotedController:
    """A spring to the target, so that the torque tells which target it was given."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self.asked: list[tuple[FloatArray, float]] = []
        self.shares: list[float] = []

    def step(
        self, terms: RobotTerms, peer_position_m: FloatArray, force_share: float, engaged_s: float
    ) -> Command:
        self._journal.note("controller")
        self.asked.append((peer_position_m.copy(), engaged_s))
        self.shares.append(force_share)
        force = force_share * (peer_position_m - terms.X)
        return Command(terms.J.T @ force, force, 0.25)


class NotedGuard(Guard):
    def __init__(self, limits: Limits, journal: Journal) -> None:
        super().__init__(limits, MS * 1e-9)
        self._journal = journal

    def torque(self, torque_nm: FloatArray, terms: RobotTerms) -> FloatArray:
        self._journal.note("guard")
        return super().torque(torque_nm, terms)


class NotedChannel(Channel):
    journal: Journal

    def latest(self, now_ns: int) -> PeerSample | None:
        self.journal.note("latest")
        return super().latest(now_ns)

    def send(self, *arguments: object) -> bool:
        self.journal.note("send")
        return super().send(*arguments)  # type: ignore[arg-type]


class NotedTelemetry(TelemetryStream):
    journal: Journal
    events: list[tuple[int, str]]

    def event(self, stamp_ns: int, text: str) -> None:
        self.events.append((stamp_ns, text))

    def put(self, *fields: object) -> None:
        self.journal.note("put")
        super().put(*fields)  # type: ignore[arg-type]


class Bench:
    events: list[tuple[int, str]]

    def __init__(
        self, *, peer_digest: int = DIGEST, send_every: int = 1, certified_s: float = CERTIFIED_S
    ) -> None:
        self.clock, self.journal, self.requests = ManualClock(), Journal(), OperatorRequests()
        self.published: list[bytes] = []
        mine, theirs = memory_links()
        self.peer_link: MemoryLink = theirs
        self.peer = self._channel(Channel, theirs, 1, peer_digest, PEER_EPOCH, 1)
        self.peer_state, self.peer_position = State.READY, np.array([0.5, 0.25])
        channel = self._channel(NotedChannel, mine, 0, DIGEST, EPOCH, send_every)
        telemetry = NotedTelemetry(2, 2, 0, DIGEST, EPOCH, self.published.append, batch_rows=1)
        channel.journal = telemetry.journal = self.journal
        telemetry.events = self.events = []
        self.device = FakeDevice(self.journal, self.clock)
        self.controller = NotedController(self.journal)
        self.model = build_robot(PlanarArm("planar", (0.4, 0.3), (1.0, 1.0)), None)
        limits = Limits(
            torque_nm=np.full(2, 5.0),
            torque_rate_nm_s=np.full(2, inf),
            velocity_rad_s=np.full(2, 9.0),
            kinetic_energy_j=inf,
            workspace_min_m=np.full(2, -1.0),
            workspace_max_m=np.full(2, 1.0),
            stops=JointStops.none(2),
            fault_after_s=0.05,
        )
        rules = EngagementRules(
            not_before_ns=0,
            hold_after_ns=HOLD_AFTER,
            stop_after_ns=STOP_AFTER,
            ramp_s=0.0,
            release_s=0.01,
            blend_s=0.01,
            align_within_m=inf,
            derate_to=0.25,
            leads=True,
            clutched=False,
        )
        relaxed = np.full(2, 0.5 * certified_s + 1e-3)
        self.site = Site(
            SiteId.LOCAL,
            device=self.device,
            robot=NotedRobot(self.model, self.journal),  # type: ignore[arg-type]
            channel=channel,
            controller=self.controller,
            supervisor=Supervisor(rules, 2),
            margin=Margin(certified_s, ((relaxed, relaxed),), MS, derate=True),
            guard=NotedGuard(limits, self.journal),
            telemetry=telemetry,
            clock=self.clock,
            times=SiteTimes(MS, send_every * MS, 3 * MS, LATE_HOLD, LATE_FAULT),
            requests=self.requests,
        )
        self.site.open()

    def _channel(
        self, kind: type[Channel], link: MemoryLink, site: int, digest: int, epoch: int, every: int
    ) -> Channel:
        return kind(
            link,
            site=site,
            session_digest=digest,
            epoch=epoch,
            dimension=2,
            send_period_ns=every * MS,
            silence_ns=HOLD_AFTER,
            session_start_ns=0,
        )

    def tick(self, count: int = 1, *, peer_speaks: bool = True, lateness_ns: int = 7) -> list[str]:
        """Let a millisecond pass, the peer speak, the site tick; return what its tick called."""
        for _ in range(count):
            self.clock.sleep_until_ns(self.clock.now_ns() + MS)
            self.peer.latest(self.clock.now_ns())
            if peer_speaks:
                rest = np.zeros(2)
                self.peer.send(self.clock.now_ns(), self.peer_state, self.peer_position, rest, rest)
            before = len(self.journal.calls)
            self.site.tick(lateness_ns)
        return self.journal.calls[before:]

    def engage(self) -> None:
        self.tick(5)
        assert self.site.state is State.ENGAGED

    def heard(self) -> Packet:
        """What the peer would hear now."""
        self.peer.latest(self.clock.now_ns())
        assert self.peer._newest is not None
        return self.peer._newest

    def said(self) -> list[str]:
        """The states and causes told as events, in order."""
        return [text for _, text in self.events]

    def row(self) -> np.void:
        return self.site.telemetry.last(1)[0]


@pytest.fixture
def bench() -> Bench:
    return Bench()


WAITING = ["read", "latest", "terms", "send", "put"]
DRIVING = ["read", "latest", "terms", "controller", "guard", "write", "send", "put"]


def test_a_tick_that_drives_writes_before_it_sends_and_reports_last(bench: Bench) -> None:
    bench.engage()
    assert bench.tick() == DRIVING


def test_before_engagement_nothing_is_enabled_and_nothing_written(bench: Bench) -> None:
    for _ in range(5):
        assert bench.tick(peer_speaks=False) == WAITING
    assert bench.site.state is State.READY
    row = bench.row()
    assert row["torque_nm"].tolist() == [0.0, 0.0]
    assert row["peer_state"] == NO_PEER_STATE
    assert np.isnan(row["peer_position_m"]).all()
    assert np.isnan(row["round_trip_s"])


def test_the_outputs_go_on_once_before_the_first_write(bench: Bench) -> None:
    bench.engage()
    calls = bench.journal.calls
    assert calls.index("enable") < calls.index("controller") < calls.index("write")
    bench.tick(30, peer_speaks=False)
    assert bench.site.state is State.HOLD
    bench.peer_state = State.ENGAGED
    bench.tick(3)
    assert bench.site.state is State.ENGAGED
    assert bench.journal.count("enable") == 1
    assert bench.journal.count("stop") == 0


def test_the_controller_is_given_the_peers_point_and_the_time_since_engagement(
    bench: Bench,
) -> None:
    bench.engage()
    _, first_s = bench.controller.asked[0]
    bench.peer_position = np.array([0.2, 0.1])
    bench.tick()
    target, engaged_s = bench.controller.asked[-1]
    assert target.tolist() == [0.2, 0.1]
    assert first_s == 0.0
    assert engaged_s == pytest.approx((len(bench.controller.asked) - 1) * 1e-3)


def test_the_point_and_the_torque_are_guarded(bench: Bench) -> None:
    bench.engage()
    bench.peer_position = np.array([40.0, 0.0])
    bench.tick()
    assert bench.controller.asked[-1][0].tolist() == [1.0, 0.0]
    asked = Command(np.array([4.0, 40.0]), np.zeros(2))
    bench.controller.step = lambda *_: asked  # type: ignore[method-assign]
    bench.device.velocity = np.array([20.0, -0.1])  # the first joint is too fast
    bench.tick()
    gravity = bench.model.terms(Q, np.zeros(2)).G
    assert bench.device.written[-1].tolist() == [gravity[0], 5.0]
    assert bench.row()["torque_nm"].tolist() == [gravity[0], 5.0]
    assert bench.row()["cut"] == Cut.WORKSPACE | Cut.VELOCITY | Cut.TORQUE


def test_the_row_tells_what_was_done(bench: Bench) -> None:
    bench.engage()
    channel = bench.site.channel
    channel.counters.lost += 5
    bench.tick()
    row, terms = bench.row(), bench.model.terms(Q, bench.device.velocity)
    assert row["stamp_ns"] == bench.clock.now_ns()
    assert row["time_ns"] == bench.clock.now_ns() - 3 * MS
    assert row["lateness_ns"] == 7
    assert row["state"] == State.ENGAGED
    assert row["peer_state"] == State.READY
    assert np.array_equal(row["q"], Q)
    assert np.array_equal(row["q_dot"], bench.device.velocity)
    assert np.array_equal(row["torque_nm"], bench.device.written[-1])
    assert np.allclose(row["position_m"], terms.X)
    assert np.allclose(row["velocity_m_s"], terms.X_dot)
    assert row["external_force_n"].tolist() == [1.0, 2.0]
    assert np.allclose(row["coupling_force_n"], bench.peer_position - terms.X)
    assert np.array_equal(row["peer_position_m"], bench.peer_position)
    assert (row["force_share"], row["engaged_s"]) == (
        bench.controller.shares[-1],
        bench.controller.asked[-1][1],
    )
    assert row["sub_task_error_rad_s"] == 0.25
    offset = channel.offset
    assert offset is not None
    assert (row["clock_offset_ns"], row["clock_uncertainty_ns"]) == offset
    assert offset.uncertainty_ns > 0
    assert row["loop_bound_s"] == bench.site.margin.loop_s
    assert (row["lost"], row["late"], row["missed"]) == (5, 0, 0)
    assert row["certified_round_trip_s"] == CERTIFIED_S
    assert row["round_trip_s"] == pytest.approx(1e-3)  # sent, used at the peer's next tick, back
    assert bench.site.error_m == pytest.approx(np.linalg.norm(bench.peer_position - terms.X))


def test_the_peer_gets_position_velocity_force_and_state(bench: Bench) -> None:
    bench.engage()
    bench.tick()
    heard = bench.peer.latest(bench.clock.now_ns())
    terms = bench.model.terms(Q, bench.device.velocity)
    assert heard is not None
    assert np.array_equal(heard.position_m, terms.X)
    assert np.array_equal(heard.velocity_m_s, terms.X_dot)
    assert heard.force_n.tolist() == [1.0, 2.0]
    assert heard.state == State.ENGAGED


def test_the_round_trip_is_unknown_again_when_the_peer_uses_none_of_mine(bench: Bench) -> None:
    bench.engage()
    assert bench.site.round_trip_s > 0.0
    bench.peer = bench._channel(Channel, bench.peer_link, 1, DIGEST, PEER_EPOCH + 1, 1)
    bench.peer_link.receive()  # the new run has heard nothing yet
    for _ in range(25):
        bench.clock.sleep_until_ns(bench.clock.now_ns() + MS)
        rest = np.zeros(2)
        bench.peer.send(bench.clock.now_ns(), State.READY, rest, rest, rest)
        bench.site.tick()
    assert bench.site.state is State.HOLD
    assert np.isnan(bench.site.round_trip_s)
    assert np.isnan(bench.row()["round_trip_s"])


def test_a_peer_of_another_session_never_gets_the_robot_moving() -> None:
    bench = Bench(peer_digest=DIGEST + 1)
    bench.tick(100)
    assert bench.site.state is State.READY
    assert bench.site.channel.other_session is not None
    assert bench.device.written == []
    assert bench.journal.count("enable") == 0


def test_silence_holds_the_last_point_under_torque_and_the_end_of_it_resumes(bench: Bench) -> None:
    bench.engage()
    ticks_of_silence = HOLD_AFTER // MS
    bench.tick(ticks_of_silence, peer_speaks=False)
    assert bench.site.state is State.ENGAGED
    assert bench.tick(peer_speaks=False) == DRIVING
    assert bench.site.state is State.HOLD
    assert np.array_equal(bench.controller.asked[-1][0], bench.peer_position)
    bench.peer_state = State.ENGAGED
    assert bench.tick() == DRIVING
    assert bench.site.state is State.ENGAGED


@pytest.mark.parametrize("peer_state", [State.FAULT, State.OFFLINE])
def test_a_peer_that_fails_or_leaves_is_seen_at_once(bench: Bench, peer_state: State) -> None:
    bench.engage()
    bench.peer_state = peer_state
    bench.tick()
    assert bench.site.state is State.HOLD


@pytest.mark.parametrize("place", ["read", "latest", *DRIVING[2:], "enable"])
def test_whatever_fails_stops_the_device_and_latches_fault(bench: Bench, place: str) -> None:
    if place != "enable":
        bench.engage()
    error = DeviceError(f"{place} failed")
    bench.journal.trouble[place] = error
    calls = bench.tick() if place != "enable" else bench.tick(5)
    if place != "enable":
        assert calls[calls.index(place) :] == [place, "stop"]
    assert bench.site.failure is error
    assert bench.site.state is State.FAULT
    del bench.journal.trouble[place]
    calls_after = bench.tick(50)
    assert calls_after == ["latest", "send"]
    assert bench.site.state is State.FAULT
    assert bench.journal.calls.index("stop") > bench.journal.calls.index(place)
    stopped_at = bench.journal.calls.index("stop")
    assert not {"read", "write", "enable"} & set(bench.journal.calls[stopped_at:])
    assert bench.peer.heard_state == State.FAULT
    bench.site.close()
    bench.peer.latest(bench.clock.now_ns())
    assert bench.peer.heard_state == State.FAULT


def test_a_fault_is_in_the_rows_with_no_torque(bench: Bench) -> None:
    bench.engage()
    bench.journal.trouble["read"] = DeviceError("cable out")
    last = bench.row().copy()
    bench.tick(4)
    row = bench.row()
    assert row["state"] == State.FAULT
    assert row["stamp_ns"] == bench.clock.now_ns()
    assert row["time_ns"] == bench.clock.now_ns() - 3 * MS
    assert row["torque_nm"].tolist() == row["coupling_force_n"].tolist() == [0.0, 0.0]
    assert np.array_equal(row["q"], last["q"])
    assert bench.site.ticks == 9


def test_the_row_of_the_tick_that_failed_has_its_reading_and_how_far_it_came(bench: Bench) -> None:
    bench.engage()
    last = bench.row()["sequence"]
    bench.device.velocity = np.array([nan, 3.0])
    bench.tick()
    row = bench.row()
    assert row["sequence"] == last + 1
    assert (row["state"], row["cut"]) == (State.FAULT, 0)
    assert np.isnan(row["q_dot"][0])
    assert row["q_dot"][1] == 3.0
    bench.tick()
    assert bench.row()["sequence"] == last + 2


def test_the_row_tells_what_the_operator_asked_for(bench: Bench) -> None:
    bench.engage()
    assert bench.row()["requests"] == 0
    bench.requests.toggle_clutch()
    bench.device.clutch = True
    bench.tick()
    assert bench.row()["requests"] == CLUTCH_BUTTON | CLUTCH
    bench.requests.toggle_clutch()
    bench.device.clutch = False
    bench.requests.stop()
    bench.tick()
    assert bench.row()["requests"] == EMERGENCY_STOP
    bench.requests.reset()
    bench.tick()
    assert bench.row()["requests"] == RESET


def test_without_the_lease_the_outputs_go_off_and_the_row_tells_of_it(bench: Bench) -> None:
    bench.engage()
    bench.requests.unleased = True
    for _ in range(1000):
        bench.tick()
    assert bench.row()["requests"] == UNLEASED
    assert bench.row()["state"] == State.READY
    bench.requests.unleased = False
    bench.tick()
    assert bench.row()["requests"] == 0


def test_what_other_threads_tell_is_an_event_each_tick(bench: Bench) -> None:
    bench.engage()
    before = len(bench.events)
    bench.site.notices.extend(["lease: one", "lease: two"])
    bench.tick()
    assert [text for _, text in bench.events[before:]] == ["lease: one"]
    bench.tick()
    assert [text for _, text in bench.events[before:]] == ["lease: one", "lease: two"]


def test_the_row_tells_when_each_stage_of_the_tick_was_passed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each call takes so long, by a clock that the calls themselves advance."""
    bench.engage()
    took_ns = {"read": 1000, "terms": 200, "guard": 30, "write": 4, "send": 50_000}

    def note(name: str) -> None:
        bench.clock.sleep_until_ns(bench.clock.now_ns() + took_ns.get(name, 0))

    monkeypatch.setattr(bench.journal, "note", note)
    bench.tick()
    row = bench.row()
    stages = [int(row[name]) for name in ("read_ns", "step_ns", "write_ns", "sent_ns")]
    assert stages == [1000, 1230, 1234, 51_234]


def test_the_row_tells_which_sample_is_in_use_and_the_clocks_offset(bench: Bench) -> None:
    bench.engage()
    bench.tick()
    row = bench.row()
    assert row["used_stamp_ns"] == row["used_arrival_ns"] == row["stamp_ns"]  # one clock, no way
    assert abs(row["clock_offset_ns"]) <= row["clock_uncertainty_ns"] <= MS
    said_ns, rest = bench.clock.now_ns() + MS, np.zeros(2)
    bench.clock.sleep_until_ns(said_ns)
    assert bench.peer.send(said_ns, bench.peer_state, bench.peer_position, rest, rest)
    bench.tick(peer_speaks=False)
    row = bench.row()
    assert (row["used_stamp_ns"], row["used_arrival_ns"]) == (said_ns, row["stamp_ns"])


def test_the_row_tells_what_was_refused_by_reason(bench: Bench) -> None:
    assert tuple(reason.value for reason in Reject) == REJECT_REASONS
    bench.engage()
    for data in (b"FH", b"x" * 156, b"y" * 156):
        bench.peer_link.send(data)
    bench.tick()
    counted = dict(zip(REJECT_REASONS, bench.row()["rejected"].tolist(), strict=True))
    assert {name: count for name, count in counted.items() if count} == {"length": 1, "magic": 2}


@pytest.mark.parametrize("reading", ["position", "velocity", "wrench"])
@pytest.mark.parametrize("engaged", [False, True])
def test_a_reading_that_is_no_number_is_a_fault(bench: Bench, reading: str, engaged: bool) -> None:
    if engaged:
        bench.engage()
    spoiled = {"position": Q.copy(), "velocity": np.zeros(2), "wrench": np.zeros(6)}
    spoiled[reading][1] = nan
    written = len(bench.device.written)
    bench.device.read = lambda: DeviceState(  # type: ignore[method-assign]
        spoiled["position"], spoiled["velocity"], spoiled["wrench"], 0
    )
    bench.tick()
    assert isinstance(bench.site.failure, GuardError)
    assert bench.site.state is State.FAULT
    assert "stop" in bench.journal.calls
    assert len(bench.device.written) == written


def test_a_torque_that_is_no_number_is_a_fault_and_never_written(bench: Bench) -> None:
    bench.engage()
    bench.controller.step = lambda *_: Command(  # type: ignore[method-assign]
        np.array([nan, 0.0]), np.zeros(2)
    )
    written = len(bench.device.written)
    bench.tick()
    assert isinstance(bench.site.failure, GuardError)
    assert len(bench.device.written) == written


def test_a_link_that_keeps_failing_neither_raises_nor_keeps_the_device(bench: Bench) -> None:
    bench.engage()
    bench.journal.trouble["send"] = OSError("no network")
    bench.tick(5)
    assert str(bench.site.failure) == "no network"
    assert bench.row()["state"] == State.FAULT
    with pytest.raises(OSError, match="no network"):
        bench.site.close()
    assert bench.journal.calls[-1] == "close"


@pytest.mark.parametrize("send_every", [1, 7])
def test_a_clean_end_stops_then_tells_the_peer_then_closes(send_every: int) -> None:
    bench = Bench(send_every=send_every)
    bench.tick(23)
    assert bench.site.state is State.ENGAGED
    before = len(bench.journal.calls)
    bench.site.close()
    calls = bench.journal.calls[before:]
    assert calls[0] == "stop"
    assert calls[-1] == "close"
    assert set(calls[1:-1]) == {"send"}
    bench.peer.latest(bench.clock.now_ns())
    assert bench.peer.heard_state == State.OFFLINE
    assert bench.site.state is State.OFFLINE


def stop_after(ticks: int) -> Callable[[], bool]:
    answers = iter([False] * ticks)
    return lambda: next(answers, True)


def test_run_ticks_at_its_period_publishes_and_ends_cleanly() -> None:
    bench = Bench()
    bench.site.run(stop_after(10))
    assert bench.site.ticks == 10
    assert bench.site.missed == 0
    rows = np.concatenate([decode_batch(payload).rows for payload in bench.published])
    assert rows["stamp_ns"].tolist() == [k * MS for k in range(1, 11)]
    assert bench.site.lateness.percentiles_us(100) == (0.0,)
    assert bench.journal.calls[-1] == "close"


@pytest.mark.parametrize("interruption", [KeyboardInterrupt(), SystemExit(1)])
@pytest.mark.parametrize("place", ["read", "send"])
def test_run_stops_the_robot_even_when_it_is_torn_down(
    interruption: BaseException, place: str
) -> None:
    bench = Bench()

    def torn_down() -> bool:
        if bench.site.ticks == 3:
            bench.journal.trouble[place] = interruption
        return False

    with pytest.raises(type(interruption)):
        bench.site.run(torn_down)
    calls = bench.journal.calls
    assert "stop" in calls[len(calls) - 1 - calls[::-1].index("read") :]
    assert calls[-1] == "close"


def test_run_counts_the_ticks_it_missed() -> None:
    bench = Bench()
    read = bench.device.read

    def slow_read() -> DeviceState:
        if bench.site.ticks == 2:
            bench.clock.sleep_until_ns(bench.clock.now_ns() + 10 * MS)
        return read()

    bench.device.read = slow_read  # type: ignore[method-assign]
    bench.site.run(stop_after(6))
    rows = np.concatenate([decode_batch(payload).rows for payload in bench.published])
    assert bench.site.missed == 9
    assert rows["missed"].tolist() == [0, 0, 0, 9, 9, 9]
    assert rows["lateness_ns"].tolist() == [0, 0, 0, 9 * MS, 0, 0]
    assert rows["duration_ns"].tolist() == [0, 0, 0, 10 * MS, 0, 0]


# the operator's stop, the peer's, and the way back


@pytest.mark.parametrize("when", ["ready", "engaged", "holding", "released"])
def test_an_emergency_stop_ends_all_torque_in_that_very_tick(bench: Bench, when: str) -> None:
    if when == "ready":
        bench.tick(peer_speaks=False)
    else:
        bench.engage()
        bench.requests.clutch = when == "released"
        bench.tick(22, peer_speaks=when != "holding")
    assert bench.site.state is State[{"holding": "HOLD"}.get(when, when.upper())]
    was_driven = when != "ready"
    bench.requests.stop()
    calls = bench.tick()
    assert calls == ["read", "latest", "terms", *["stop"] * was_driven, "send", "put"]
    assert bench.site.state is State.EMERGENCY_STOP
    assert bench.heard().state == State.EMERGENCY_STOP
    row = bench.row()
    assert row["state"] == State.EMERGENCY_STOP
    assert row["torque_nm"].tolist() == row["coupling_force_n"].tolist() == [0.0, 0.0]
    assert row["force_share"] == 0.0
    assert bench.tick(50) == ["latest", "send"]
    assert bench.site.state is State.EMERGENCY_STOP
    assert bench.row()["state"] == State.EMERGENCY_STOP
    assert bench.site.failure is None
    assert bench.said()[-1] == "EMERGENCY_STOP: the operator of this site stopped it"


def test_a_peers_emergency_stop_stops_the_device_too(bench: Bench) -> None:
    bench.engage()
    bench.peer_state = State.EMERGENCY_STOP
    calls = bench.tick()
    assert "stop" in calls
    assert "write" not in calls
    assert bench.site.state is State.EMERGENCY_STOP
    assert bench.said()[-1] == "EMERGENCY_STOP: the peer is in emergency stop"


@pytest.mark.parametrize("why", ["stop", "fault"])
def test_a_reset_opens_the_device_anew_and_the_site_engages_again(bench: Bench, why: str) -> None:
    bench.engage()
    if why == "stop":
        bench.requests.stop()
    else:
        bench.journal.trouble["write"] = DeviceError("amplifier too hot")
    bench.tick(3)
    bench.journal.trouble.clear()
    assert bench.site.state in (State.EMERGENCY_STOP, State.FAULT)
    written = len(bench.device.written)
    bench.requests.reset()
    assert bench.tick() == ["latest", "send", "close", "open"]
    assert bench.site.state is State.READY
    assert bench.site.failure is None
    assert bench.said()[-1] == "READY: reset by the operator of this site"
    bench.peer_state = State.EMERGENCY_STOP
    bench.tick(10)
    assert bench.site.state is State.READY
    assert len(bench.device.written) == written
    bench.peer_state = State.READY
    bench.tick(3)
    assert bench.site.state is State.ENGAGED
    assert len(bench.device.written) > written
    assert bench.journal.count("enable") == 2


@pytest.mark.parametrize("place", ["open", "close"])
@pytest.mark.parametrize("why", ["stop", "fault"])
def test_a_reset_that_fails_is_a_fault_and_may_be_tried_again(
    bench: Bench, why: str, place: str
) -> None:
    bench.engage()
    if why == "stop":
        bench.requests.stop()
    else:
        bench.journal.trouble["read"] = DeviceError("cable out")
    bench.tick()
    bench.journal.trouble = {place: DeviceError("still out")}
    bench.requests.reset()
    calls = bench.tick()
    assert calls[-1] == "stop"
    assert bench.site.state is State.FAULT
    assert str(bench.site.failure) == "still out"
    assert bench.said()[-1] == "FAULT: DeviceError: still out"
    bench.tick(3)
    assert bench.heard().state == State.FAULT
    assert bench.site.state is State.FAULT
    bench.journal.trouble.clear()
    bench.requests.reset()
    bench.tick()
    assert bench.site.state is State.READY
    assert bench.site.failure is None


def test_a_reset_asked_for_too_early_undoes_no_later_stop(bench: Bench) -> None:
    bench.engage()
    bench.requests.reset()
    bench.tick()
    bench.peer_state = State.EMERGENCY_STOP
    bench.tick(5)
    assert bench.site.state is State.EMERGENCY_STOP


def test_a_stop_asked_for_while_stopped_is_over_with_the_reset(bench: Bench) -> None:
    bench.engage()
    bench.requests.stop()
    bench.tick()
    bench.requests.stop()
    bench.tick()
    bench.requests.reset()
    bench.tick(4)
    assert bench.site.state is State.ENGAGED


def test_a_stop_asked_for_while_the_device_opens_is_heeded(bench: Bench) -> None:
    bench.engage()
    bench.requests.stop()
    bench.tick()
    slow_open = bench.device.open
    bench.device.open = lambda: (slow_open(), bench.requests.stop())  # type: ignore[assignment, method-assign, return-value]
    bench.requests.reset()
    bench.tick(5)
    assert bench.site.state is State.EMERGENCY_STOP
    assert bench.journal.count("enable") == 1


# the clutch


@pytest.mark.parametrize("how", ["button", "request"])
def test_the_clutch_releases_the_hand_and_keeps_the_point_told(bench: Bench, how: str) -> None:
    def hold(opened: bool) -> None:
        if how == "button":
            bench.device.clutch = opened
        else:
            bench.requests.toggle_clutch()

    bench.peer_state = State.ENGAGED
    bench.engage()
    told = bench.heard().position_m
    hold(True)
    assert bench.tick() == DRIVING
    assert bench.site.state is State.RELEASED
    assert bench.said()[-1] == "RELEASED: the clutch is open"
    bench.device.position = np.add(Q, [0.2, -0.1])
    bench.tick(12)
    moved = (
        bench.model.terms(bench.device.position, np.zeros(2)).X
        - bench.model.terms(Q, np.zeros(2)).X
    )
    assert bench.heard().position_m == pytest.approx(told)
    assert bench.heard().state == State.RELEASED
    row = bench.row()
    assert row["offset_m"] == pytest.approx(moved)
    assert row["force_share"] == bench.controller.shares[-1] == 0.0
    hold(False)
    bench.tick()
    assert bench.site.state is State.ENGAGED
    assert bench.heard().position_m == pytest.approx(told)
    assert bench.controller.asked[-1][0] == pytest.approx(bench.peer_position + moved)
    bench.device.position = Q
    bench.tick()
    assert bench.heard().position_m == pytest.approx(told - moved)


def test_a_stopped_site_goes_on_telling_the_point_it_told_last(bench: Bench) -> None:
    bench.peer_state = State.ENGAGED
    bench.engage()
    told = bench.heard().position_m
    bench.device.clutch = True
    bench.tick(2)
    bench.device.position = np.add(Q, [0.2, -0.1])
    bench.tick(12)
    bench.journal.trouble["read"] = DeviceError("cable out")
    bench.tick(3)
    assert bench.heard().state == State.FAULT
    assert bench.heard().position_m == pytest.approx(told)
    bench.site.close()
    assert bench.heard().position_m == pytest.approx(told)


# late ticks, long holds, old loops


def test_late_ticks_in_a_row_lead_to_hold_and_then_to_fault(bench: Bench) -> None:
    bench.peer_state = State.ENGAGED
    bench.engage()
    for _ in range(3):  # one on time in between, and the count begins anew
        bench.tick(LATE_HOLD - 1, lateness_ns=MS + 1)
        bench.tick(lateness_ns=MS)
    assert bench.site.state is State.ENGAGED
    bench.tick(LATE_HOLD, lateness_ns=MS + 1)
    assert bench.site.state is State.HOLD
    assert bench.said()[-1] == "HOLD: the ticks of this site come late, one after the other"
    bench.tick(LATE_FAULT - LATE_HOLD - 1, lateness_ns=MS + 1)
    assert bench.site.state is State.HOLD
    calls = bench.tick(lateness_ns=MS + 1)
    assert calls == ["read", "latest", "terms", "stop"]
    assert bench.site.state is State.FAULT
    assert isinstance(bench.site.failure, LateError)
    bench.requests.reset()
    bench.tick()
    bench.tick(lateness_ns=50 * MS)  # opening the device took its time
    bench.tick(3)
    assert bench.site.state is State.ENGAGED


def test_one_tick_on_time_ends_the_hold_of_late_ones(bench: Bench) -> None:
    bench.peer_state = State.ENGAGED
    bench.engage()
    bench.tick(LATE_HOLD, lateness_ns=MS + 1)
    bench.tick()
    assert bench.site.state is State.ENGAGED


def test_a_long_hold_switches_the_outputs_off_and_the_peers_return_on(bench: Bench) -> None:
    bench.engage()
    bench.peer_state = State.FAULT
    bench.tick(STOP_AFTER // MS)
    assert bench.site.state is State.HOLD
    assert bench.row()["force_share"] < 0.05  # the last of its release
    assert bench.tick() == ["read", "latest", "terms", "stop", "send", "put"]
    assert bench.site.state is State.READY
    assert bench.said()[-1] == "READY: held for too long"
    assert bench.tick(20) == WAITING
    assert bench.journal.count("stop") == 1
    bench.peer_state = State.READY
    calls = bench.tick()
    assert bench.site.state is State.ENGAGED
    assert calls == ["read", "latest", "terms", "enable", *DRIVING[3:]]


def test_the_guard_begins_anew_with_the_outputs(bench: Bench) -> None:
    bench.engage()
    restarts: list[int] = []
    bench.site.guard.restart = lambda: restarts.append(bench.site.ticks)  # type: ignore[method-assign]
    bench.peer_state = State.FAULT
    bench.tick(STOP_AFTER // MS + 1)
    assert bench.site.state is State.READY
    assert restarts == []
    bench.peer_state = State.READY
    bench.tick()
    assert restarts == [bench.site.ticks - 1]


def test_an_older_loop_gets_a_smaller_share_of_force_and_then_none() -> None:
    bench = Bench(certified_s=0.01)
    bench.peer_state = State.ENGAGED
    bench.engage()
    bench.tick(5)
    assert bench.row()["force_share"] == 1.0
    assert bench.row()["loop_bound_s"] <= 0.01
    bench.tick(15, peer_speaks=False)
    bench.tick()  # the loop of late, 0.016 s and a few ticks
    for _ in range(12):
        bench.tick()
    row = bench.row()
    assert row["loop_bound_s"] > 0.01
    proven = bench.site.margin.share(round((row["loop_bound_s"] - 2e-3) * 1e9))
    assert 0.25 < proven < 1.0
    assert bench.site.state is State.ENGAGED
    assert row["force_share"] == bench.controller.shares[-1] == pytest.approx(proven)
    bench.tick(HOLD_AFTER // MS, peer_speaks=False)
    for _ in range(60):
        bench.tick()
    assert bench.site.state is State.ENGAGED
    bench.site.margin.certified_s = 1e-3
    bench.site.margin._relaxations = ((np.full(2, 2e-3), np.full(2, 2e-3)),)
    bench.tick()
    assert bench.site.state is State.HOLD
    assert bench.said()[-1] == "HOLD: the loop is older than the gains are proven for"


def test_every_change_of_state_is_an_event(bench: Bench) -> None:
    bench.peer_state = State.ENGAGED
    bench.engage()
    assert bench.events == [(bench.events[0][0], "ENGAGED: both sites agree")]
    bench.tick(22, peer_speaks=False)
    bench.tick(2)
    bench.device.clutch = True
    bench.tick(2)
    bench.device.clutch = False
    bench.tick(12)
    bench.requests.stop()
    bench.tick(2)
    bench.requests.reset()
    bench.tick(4)
    bench.journal.trouble["write"] = DeviceError("too hot")
    bench.tick(3)
    stamps = [stamp for stamp, _ in bench.events]
    assert stamps == sorted(stamps)
    assert bench.said() == [
        "ENGAGED: both sites agree",
        "HOLD: the peer is silent",
        "ENGAGED: both sites agree",
        "RELEASED: the clutch is open",
        "ENGAGED: both sites agree",
        "EMERGENCY_STOP: the operator of this site stopped it",
        "READY: reset by the operator of this site",
        "ENGAGED: both sites agree",
        "FAULT: DeviceError: too hot",
    ]


def test_de_rating_and_its_end_are_told(bench: Bench) -> None:
    bench.engage()
    for age_ns in (500 * MS, 100 * MS):
        bench.site.margin.share = lambda _, age_ns=age_ns: 0.5 if age_ns > 400 * MS else 1.0  # type: ignore[method-assign]
        bench.tick(50)
    told = [text.split(":")[0] for text in bench.said()]
    assert told[-2:] == ["de-rated", "full gains"]
