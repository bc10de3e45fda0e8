"""What a robot reads while nothing drives it, and how each joint answers a small torque."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from control_law.ramp import smooth_ramp
from hardware.interface import Device, DeviceState
from hardware.robot_model import RobotModel
from site_runtime.clock import Clock, Pacer
from site_runtime.guard import Guard

FloatArray = npt.NDArray[np.float64]

RAMP_S = 0.25
HOLD_S = 0.5
SETTLE_S = 1.0  # outlasts a driver's own ramp after enabling
BRAKE_S = 0.02
STILL_RAD = 1e-3
RUN_AWAY = 4.0


class Interrupted(Exception):  # noqa: N818  an end, not an error
    """The user asked to stop."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What a device read at rest: means and standard deviations, rates, ages, durations.

    Positions [rad] and velocities [rad/s] are (n,), wrenches [N, N·m] are (6,). `rate_hz` counts
    readings, `fresh_hz` those with a stamp of their own. Ages are those of the stamps when read;
    durations, those of `read`; each as median, 99 % and largest [s].
    """

    rate_hz: float
    fresh_hz: float
    age_s: FloatArray
    duration_s: FloatArray
    position_rad: FloatArray
    position_noise_rad: FloatArray
    velocity_rad_s: FloatArray
    velocity_noise_rad_s: FloatArray
    wrench: FloatArray
    wrench_noise: FloatArray


class Answer(Enum):
    """How a joint answered a torque."""

    FOLLOWED = "moves with the torque"
    STILL = "does not move"
    AGAINST = "moves AGAINST the torque: a sign is wrong; stopped"
    RAN_AWAY = "RAN AWAY; stopped"


@dataclass(frozen=True, slots=True)
class Push:
    """A torque on one joint, and the farthest that every joint went from where it was, (n,)."""

    joint: int
    torque_nm: float
    travel_rad: FloatArray
    answer: Answer


def watch(
    device: Device,
    clock: Clock,
    period_ns: int,
    duration_s: float,
    should_stop: Callable[[], bool],
) -> Readings:
    """Read an open device, its outputs off, at the loop's rate; raises DeviceError, Interrupted."""
    pacer = Pacer(clock, period_ns)
    start_ns = clock.now_ns()
    states: list[DeviceState] = []
    ages_s, durations_s = [], []
    while clock.now_ns() - start_ns < duration_s * 1e9 or len(states) < 2:
        if should_stop():
            raise Interrupted
        pacer.wait()
        before_ns = clock.now_ns()
        states.append(device.read())
        after_ns = clock.now_ns()
        ages_s.append((after_ns - states[-1].stamp_ns) * 1e-9)
        durations_s.append((after_ns - before_ns) * 1e-9)
    elapsed_s = (clock.now_ns() - start_ns) * 1e-9
    position, velocity, wrench = (
        np.array([getattr(state, name) for state in states])
        for name in ("position_rad", "velocity_rad_s", "wrench")
    )
    fresh = np.count_nonzero(np.diff([state.stamp_ns for state in states]))
    return Readings(
        rate_hz=len(states) / elapsed_s,
        fresh_hz=fresh / elapsed_s,
        age_s=np.percentile(ages_s, (50, 99, 100)),
        duration_s=np.percentile(durations_s, (50, 99, 100)),
        position_rad=position.mean(axis=0),
        position_noise_rad=position.std(axis=0),
        velocity_rad_s=velocity.mean(axis=0),
        velocity_noise_rad_s=velocity.std(axis=0),
        wrench=wrench.mean(axis=0),
        wrench_noise=wrench.std(axis=0),
    )


class TorqueTest:
    """Small torques on an open device, one joint at a time, through the guard.

    A push of `torque_nm[joint]` is ramped in, held and ramped out; it ends early once the joint
    has moved by `motion_rad`. Meanwhile and after, gravity is carried and all joints are braked
    alike, by the model's inertia, with no more than each one's test torque. A joint that goes the
    other way, or several times as far, is stopped at once.
    """

    def __init__(
        self,
        device: Device,
        robot: RobotModel,
        guard: Guard,
        clock: Clock,
        period_ns: int,
        *,
        torque_nm: FloatArray,
        motion_rad: float,
        should_stop: Callable[[], bool],
    ) -> None:
        self._device = device
        self._robot = robot
        self._guard = guard
        self._clock = clock
        self._period_ns = period_ns
        self._torque_nm = torque_nm
        self._motion_rad = motion_rad
        self._should_stop = should_stop

    def run(self) -> list[Push]:
        """Push every joint one way and the other; the outputs are off afterwards, come what may.

        Raises what device and guard raise, and Interrupted. The last push tells why it ended early.
        """
        pushes: list[Push] = []
        try:
            self._device.enable()
            rest = self._push(0, 0.0, SETTLE_S)
            if rest.answer is Answer.RAN_AWAY:
                return [rest]
            for joint in range(self._robot.joints):
                for sign in (1.0, -1.0):
                    pushes.append(self._push(joint, sign, 2.0 * RAMP_S + HOLD_S))
                    if pushes[-1].answer in (Answer.AGAINST, Answer.RAN_AWAY):
                        return pushes
                    rest = self._push(joint, 0.0, SETTLE_S)
                    if rest.answer is Answer.RAN_AWAY:
                        return [*pushes, rest]
        finally:
            self._device.stop()
        return pushes

    def _push(self, joint: int, sign: float, duration_s: float) -> Push:
        """Push one joint, or none with sign 0; the device is stopped where it answers badly."""
        start_ns = self._clock.now_ns()
        pacer = Pacer(self._clock, self._period_ns)
        start_rad: FloatArray | None = None
        farthest_rad = np.zeros(self._robot.joints)
        end_s = duration_s
        answer = Answer.STILL
        while (elapsed_s := (self._clock.now_ns() - start_ns) * 1e-9) < duration_s:
            if self._should_stop():
                raise Interrupted
            pacer.wait()
            reading = self._device.read()
            self._guard.reading(reading)
            start_rad = reading.position_rad if start_rad is None else start_rad
            travel_rad = reading.position_rad - start_rad
            farther = np.abs(travel_rad) > np.abs(farthest_rad)
            farthest_rad[farther] = travel_rad[farther]
            if abs(travel_rad[joint]) > self._motion_rad:
                end_s = min(end_s, elapsed_s)
            against = -sign * travel_rad[joint] > self._motion_rad
            if against or np.abs(travel_rad).max() > RUN_AWAY * self._motion_rad:
                self._device.stop()  # with a wrong sign the brakes drive
                answer = Answer.AGAINST if against else Answer.RAN_AWAY
                break
            left_s = duration_s - elapsed_s if elapsed_s < end_s else 0.0
            size = smooth_ramp(elapsed_s, RAMP_S)[0] * smooth_ramp(left_s, RAMP_S)[0]
            self._write(reading, joint, sign * size)
        if answer is Answer.STILL and sign and abs(farthest_rad[joint]) > STILL_RAD:
            with_it = sign * farthest_rad[joint] > 0.0
            answer = Answer.FOLLOWED if with_it else Answer.AGAINST
        return Push(joint, sign * float(self._torque_nm[joint]), farthest_rad, answer)

    def _write(self, reading: DeviceState, joint: int, share: float) -> None:
        """Command so much of a joint's test torque, every joint braked."""
        terms = self._robot.terms(reading.position_rad, reading.velocity_rad_s)
        torque_nm = -(terms.M @ terms.q_dot) / BRAKE_S
        torque_nm[joint] += share * self._torque_nm[joint]
        torque_nm = terms.G + np.clip(torque_nm, -self._torque_nm, self._torque_nm)
        self._device.write(self._guard.torque(torque_nm, terms))
