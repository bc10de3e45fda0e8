"""One site: its tick, and the run that carries it."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import dist, nan

import numpy as np
import numpy.typing as npt

from channel.channel import Channel, Counters, PeerSample
from channel.clock_offset import OffsetEstimate
from channel.packet import Reject
from hardware.interface import Device, DeviceState
from hardware.robot_model import RobotModel, RobotTerms
from site_runtime.clock import Clock, LatenessHistogram, Pacer
from site_runtime.controller import Command, Controller
from site_runtime.guard import Guard
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
from site_runtime.supervisor import DRIVEN, STOPPED, Cause, State, Supervisor
from site_runtime.tick_phase import TickPhase
from telemetry.rows import NO_PEER_STATE
from telemetry.stream import TelemetryStream

FloatArray = npt.NDArray[np.float64]
_FAREWELL_PACKETS = 5
_READ, _STEP, _WRITE, _SENT = range(4)
_MOST_COUNTED = 2**32 - 1
_NO_OFFSET = OffsetEstimate(0, -1)


@dataclass(frozen=True, slots=True)
class SiteTimes:
    """Tick period, time between packets, session time zero on the site's clock [ns].

    So many late ticks in a row, each by more than a period, lead to HOLD and to FAULT.
    """

    period_ns: int
    send_period_ns: int
    session_start_ns: int
    late_ticks_to_hold: int
    late_ticks_to_fault: int


class LateError(Exception):
    """The loop does not keep its rate any more: the site goes to FAULT."""


class Site:
    """Device, channel, controller, supervisor and guard of one side of the teleoperation.

    The same object runs in a daemon on a steady clock and in simulation on a manual one.
    """

    def __init__(
        self,
        identity: SiteId,
        *,
        device: Device,
        robot: RobotModel,
        channel: Channel,
        controller: Controller,
        supervisor: Supervisor,
        margin: Margin,
        guard: Guard,
        telemetry: TelemetryStream,
        clock: Clock,
        times: SiteTimes,
        requests: OperatorRequests,
    ) -> None:
        self.identity = identity
        self.channel = channel
        self.guard = guard
        self.margin = margin
        self.requests = requests
        self.telemetry = telemetry
        self.notices: deque[str] = deque()
        """What other threads have to tell of this site; a tick makes an event of the oldest."""
        self.lateness = LatenessHistogram()
        self.failure: Exception | None = None
        self.ticks = 0
        self.missed = 0
        self.round_trip_s = nan
        self._apart: tuple[FloatArray, FloatArray] | None = None
        self._device = device
        self._robot = robot
        self._controller = controller
        self._supervisor = supervisor
        self._clock = clock
        self._times = times
        self._idle = Command(np.zeros(robot.joints), np.zeros(robot.task_dimension))
        self._duration_ns = 0
        self._late_ticks = 0
        self._derated = False
        self._told_m = np.zeros(robot.task_dimension)
        self._nowhere_m = np.full(robot.task_dimension, nan)
        self._stages_ns = [0, 0, 0, 0]
        self._rejected = [0] * len(Reject)
        self._rejected_total = 0

    @property
    def state(self) -> State:
        """The supervisor's state."""
        return self._supervisor.state

    @property
    def cause(self) -> Cause:
        """Why it is in that state."""
        return self._supervisor.cause

    @property
    def scale(self) -> float:
        """Share of the gains left by de-rating, 1 if none is taken."""
        return self._supervisor.scale

    @property
    def error_m(self) -> float:
        """Distance from the point followed [m], NaN before there is one; any thread may ask."""
        return nan if self._apart is None else dist(*self._apart)

    @property
    def apart_m(self) -> float:
        """How far apart the robots' points were when last compared [m]."""
        return self._supervisor.apart_m

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Tick at absolute deadlines until told to stop; the robot is stopped however it ends."""
        self.open()
        try:
            pacer = Pacer(self._clock, self._times.period_ns)
            phase = TickPhase(self._times.period_ns)
            while not should_stop():
                lateness_ns = pacer.wait()
                self.lateness.add(lateness_ns)
                self.missed = pacer.missed
                self.tick(lateness_ns)
                self.telemetry.flush()
                if self.identity is SiteId.REMOTE:  # if both did, they would chase each other
                    pacer.shift(phase.step(self.channel.longest_way_ns))
        finally:
            self.close()

    def open(self) -> None:
        """Open the device; its outputs stay off until the peer is there."""
        self._device.open()

    def tick(self, lateness_ns: int = 0) -> None:
        """One tick. Whatever goes wrong ends in the device's stop, which never raises."""
        now_ns = self._clock.now_ns()
        asked = self.requests.take()
        if asked & UNLEASED:
            self.channel.welcome_back()
        if self.notices:
            self.telemetry.event(now_ns, self.notices.popleft())
        if self._supervisor.state in STOPPED:
            self._tick_stopped(now_ns, lateness_ns, asked)
            return
        reading: DeviceState | None = None
        stages_ns = self._stages_ns = [0, 0, 0, 0]
        try:
            reading = self._device.read()
            stages_ns[_READ] = self._clock.now_ns() - now_ns
            asked |= CLUTCH_BUTTON if reading.clutch else 0
            self.guard.reading(reading)
            peer = self.channel.latest(now_ns)
            terms = self._robot.terms(reading.position_rad, reading.velocity_rad_s)
            state = self._supervise(now_ns, lateness_ns, peer, terms, asked)
            command, share, engaged_s = self._idle, 0.0, nan
            if state in DRIVEN and self._supervisor.target_m is not None:
                share = self._supervisor.force_share(now_ns)
                engaged_s = self._supervisor.engaged_s(now_ns)
                command = self.command(terms, self._supervisor.target_m, share, engaged_s)
                stages_ns[_STEP] = self._clock.now_ns() - now_ns
                self._device.write(command.torque_nm)
                stages_ns[_WRITE] = self._clock.now_ns() - now_ns
            force_n = reading.wrench[: self._robot.task_dimension]
            self._told_m = self._supervisor.told_m(terms.X)
            if self.channel.send(now_ns, state, self._told_m, terms.X_dot, force_n):
                stages_ns[_SENT] = self._clock.now_ns() - now_ns
            self._put(
                now_ns, lateness_ns, asked, state, peer, terms, force_n, command, share, engaged_s
            )
        except Exception as failure:
            self._fail(now_ns, failure)
            self._put_failed(now_ns, lateness_ns, asked, reading)
        self.ticks += 1
        self._duration_ns = self._clock.now_ns() - now_ns

    def command(
        self, terms: RobotTerms, target_m: FloatArray, share: float, engaged_s: float
    ) -> Command:
        """Return what the guard leaves of the controller's command toward a point (z,) [m]."""
        command = self._controller.step(terms, self.guard.target(target_m), share, engaged_s)
        torque_nm = self.guard.torque(command.torque_nm, terms)
        if torque_nm is command.torque_nm:
            return command
        return Command(torque_nm, command.coupling_force_n, command.sub_task_error_rad_s)

    def close(self) -> None:
        """Stop the robot, tell the peer, close the device. Never raises before the stop."""
        self._device.stop()
        self._supervisor.stop()
        try:
            for packet in range(_FAREWELL_PACKETS):
                self._say(self._clock.now_ns() + packet * self.channel.send_period_ns)
            self.telemetry.drain()
        finally:
            self._device.close()

    def _supervise(
        self,
        now_ns: int,
        lateness_ns: int,
        peer: PeerSample | None,
        terms: RobotTerms,
        asked: int,
    ) -> State:
        """Update the supervisor; switch the outputs on and off with its state."""
        times, supervisor, before = self._times, self._supervisor, self._supervisor.state
        self._late_ticks = self._late_ticks + 1 if lateness_ns > times.period_ns else 0
        if self._late_ticks >= times.late_ticks_to_fault:
            raise LateError(f"{self._late_ticks} ticks in a row came late: the loop is too slow")
        state = supervisor.update(
            now_ns,
            self.channel,
            peer,
            terms.X,
            scale=self.margin.share(self.channel.loop_bound_ns),
            late=self._late_ticks >= times.late_ticks_to_hold,
            clutch=bool(asked & (CLUTCH_BUTTON | CLUTCH)),
            emergency_stop=bool(asked & EMERGENCY_STOP),
            unleased=bool(asked & UNLEASED),
        )
        if state is not before:
            if state in DRIVEN and before not in DRIVEN:
                self.guard.restart()
                self._device.enable()
            elif before in DRIVEN and state not in DRIVEN:
                self._device.stop()
            self.telemetry.event(now_ns, f"{state.name}: {supervisor.cause.value}")
        if state is State.ENGAGED and (supervisor.scale < 1.0) is not self._derated:
            self._derated = not self._derated
            margin = self.margin
            self.telemetry.event(
                now_ns,
                f"{'de-rated' if self._derated else 'full gains'}: the loop is up to "
                f"{margin.loop_s:.3f} s old, certified {margin.certified_s:.3f} s",
            )
        return state

    def _tick_stopped(self, now_ns: int, lateness_ns: int, asked: int) -> None:
        """Tell the peer and people that the device is stopped, and wait for a reset."""
        with suppress(Exception):  # the link may be what failed; the first failure is the one told
            self.channel.latest(now_ns)
            self._say(now_ns)
        self.telemetry.repeat_stopped(
            stamp_ns=now_ns,
            time_ns=now_ns - self._times.session_start_ns,
            lateness_ns=lateness_ns,
            state=self._supervisor.state,
            requests=asked,
        )
        self.ticks += 1
        if asked & RESET:
            self._reset(now_ns)

    def _reset(self, now_ns: int) -> None:
        """Open the device anew, outputs off; it may take its time. A fault if it fails."""
        try:
            self._device.close()
            self._device.open()
        except Exception as failure:
            self._fail(now_ns, failure)
            return
        self.failure = None
        self._late_ticks = 0
        self._supervisor.reset()
        self.telemetry.event(now_ns, "READY: " + self._supervisor.cause.value)

    def _fail(self, now_ns: int, failure: Exception) -> None:
        """Stop the device first; then latch FAULT and tell why."""
        self._device.stop()
        self._supervisor.fault()
        self.failure = failure
        self.telemetry.event(now_ns, f"FAULT: {type(failure).__name__}: {failure}")

    def _say(self, now_ns: int) -> None:
        rest = np.zeros(self._robot.task_dimension)
        self.channel.send(now_ns, self._supervisor.state, self._told_m, rest, rest)

    def _put(
        self,
        now_ns: int,
        lateness_ns: int,
        asked: int,
        state: State,
        peer: PeerSample | None,
        terms: RobotTerms,
        force_n: FloatArray,
        command: Command,
        share: float,
        engaged_s: float,
    ) -> None:
        """Write this tick's row."""
        channel, supervisor, margin = self.channel, self._supervisor, self.margin
        target_m = supervisor.target_m
        if target_m is None:
            target_m = self._nowhere_m
        else:
            self._apart = (terms.X, target_m)
        if peer is None:
            peer_state, used_stamp_ns, used_arrival_ns, delay_s = NO_PEER_STATE, 0, 0, nan
            self.round_trip_s = nan
        else:
            peer_state, used_stamp_ns = peer.state, peer.stamp_ns
            used_arrival_ns, delay_s = peer.arrival_ns, peer.age_ns * 1e-9
            trip_ns = peer.round_trip_ns
            self.round_trip_s = nan if trip_ns is None else trip_ns * 1e-9
        offset_ns, uncertainty_ns = channel.offset or _NO_OFFSET
        counters = channel.counters
        read_ns, step_ns, write_ns, sent_ns = self._stages_ns
        self.telemetry.put(  # in the order of COLUMNS
            now_ns,
            now_ns - self._times.session_start_ns,
            lateness_ns,
            self._duration_ns,
            read_ns,
            step_ns,
            write_ns,
            sent_ns,
            state,
            peer_state,
            asked,
            self.guard.cut,
            terms.q,
            terms.q_dot,
            command.torque_nm,
            terms.X,
            terms.X_dot,
            force_n,
            command.coupling_force_n,
            target_m,
            supervisor.offset_m,
            share,
            engaged_s,
            used_stamp_ns,
            used_arrival_ns,
            offset_ns,
            uncertainty_ns,
            delay_s,
            self.round_trip_s,
            margin.loop_s,
            margin.certified_s,
            command.sub_task_error_rad_s,
            counters.lost,
            counters.late,
            self._rejected
            if counters.rejected_total == self._rejected_total
            else self._count_rejected(counters),
            self.missed,
        )

    def _put_failed(
        self, now_ns: int, lateness_ns: int, asked: int, reading: DeviceState | None
    ) -> None:
        """Write the row of a tick that did not come to its end, as far as it came."""
        with suppress(Exception):  # the reading may be what was wrong
            self.telemetry.repeat_stopped(
                stamp_ns=now_ns,
                time_ns=now_ns - self._times.session_start_ns,
                lateness_ns=lateness_ns,
                state=self._supervisor.state,
                requests=asked,
                read_ns=self._stages_ns[_READ],
                step_ns=self._stages_ns[_STEP],
                reading=None
                if reading is None
                else (
                    reading.position_rad,
                    reading.velocity_rad_s,
                    reading.wrench[: self._robot.task_dimension],
                ),
            )

    def _count_rejected(self, counters: Counters) -> list[int]:
        """Return the counts by reason anew, in the order of `Reject`."""
        self._rejected_total = counters.rejected_total
        self._rejected = [min(counters.rejected[reason], _MOST_COUNTED) for reason in Reject]
        return self._rejected
