"""A simulated arm: rigid-body dynamics advanced to the site's clock at every read."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from hardware.interface import (
    ContactForce,
    DeviceConfigurationError,
    DeviceError,
    DeviceState,
    FloatArray,
    JointStops,
)
from hardware.registry import DeviceContext, DriverEntry
from hardware.robot_model import RobotModel

MAX_CATCH_UP_NS = 50_000_000
DIVERGED_RAD_S = 1e4  # no arm moves so; beyond it the numbers are the integrator's, soon infinite
FRICTION_SWEEPS = 20


@dataclass(frozen=True, slots=True)
class SimulatedSettings:
    """Settings of the driver "simulated": integrator, imperfections, brakes.

    `step_s` is the longest integration step. `encoder_resolution_rad` > 0 quantises the position
    and replaces the exact velocity by its backward difference through a first-order filter of time
    constant `velocity_filter_s`. Friction and `torque_limit_nm` hold for each joint; noise is
    Gaussian, one standard deviation. A written torque acts `torque_delay_s` later, the one before
    it until then. With `brakes` the arm stands still while outputs are off.
    """

    initial_position_rad: tuple[float, ...]
    driver: Literal["simulated"] = "simulated"
    integrator: Literal["semi-implicit", "rk4"] = "semi-implicit"
    step_s: float = 0.001
    encoder_resolution_rad: float = 0.0
    velocity_filter_s: float = 0.0038
    coulomb_friction_nm: float = 0.0
    viscous_friction_nm_s: float = 0.0
    torque_limit_nm: float | None = None
    torque_delay_s: float = 0.0
    velocity_noise_rad_s: float = 0.0
    force_noise_n: float = 0.0
    brakes: bool = True

    def __post_init__(self) -> None:
        if not all(math.isfinite(angle) for angle in self.initial_position_rad):
            raise DeviceConfigurationError(
                f"initial_position_rad is {self.initial_position_rad}; every angle must be finite"
            )
        if not 1e-6 <= self.step_s <= MAX_CATCH_UP_NS * 1e-9:
            raise DeviceConfigurationError(
                f"step_s is {self.step_s}; choose between 1e-6 and {MAX_CATCH_UP_NS * 1e-9:g} s"
            )
        for name in (
            "encoder_resolution_rad",
            "velocity_filter_s",
            "coulomb_friction_nm",
            "viscous_friction_nm_s",
            "torque_delay_s",
            "velocity_noise_rad_s",
            "force_noise_n",
        ):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise DeviceConfigurationError(f"{name} is {value}; it must be zero or positive")
        if self.torque_limit_nm is not None and not self.torque_limit_nm > 0.0:
            raise DeviceConfigurationError(
                f"torque_limit_nm is {self.torque_limit_nm}; it must be positive, or left out"
            )

    @property
    def difference_filter_s(self) -> float | None:
        """Time constant of the filter on differenced velocities [s]; None: velocity is exact."""
        return self.velocity_filter_s if self.encoder_resolution_rad > 0.0 else None


class _Touched(NamedTuple):
    """What a contact did to the arm in one state; its arrays are never written into."""

    time_s: float
    q: FloatArray  # (n,)
    q_dot: FloatArray  # (n,)
    force_n: FloatArray  # (z,)
    torque_nm: FloatArray  # (n,)


class SimulatedDevice:
    """An arm that obeys M q̈ + C q̇ + G = τ + JᵀF and the given imperfections; a `Device`.

    `read` integrates from the previous reading to now with the last torque held, at most 50 ms of
    it: time beyond is not simulated and adds to `skipped_ns`. One clock step of exactly `step_s`
    is one integration step, so a manual clock makes runs equal bit for bit; a delayed torque that
    comes into force within it splits it there, to the nanosecond. Joints have no stops.
    """

    def __init__(
        self,
        model: RobotModel,
        settings: SimulatedSettings,
        contact: ContactForce | None,
        now_ns: Callable[[], int],
        session_start_ns: int,
        seed: int,
    ) -> None:
        if len(settings.initial_position_rad) != model.joints:
            raise DeviceConfigurationError(
                f"initial_position_rad has {len(settings.initial_position_rad)} angles, the robot "
                f"has {model.joints} joints"
            )
        self.skipped_ns = 0
        self._model = model
        self._settings = settings
        self._contact = contact
        self._now_ns = now_ns
        self._session_start_ns = session_start_ns
        self._seed = seed
        self._step_ns = round(settings.step_s * 1e9)
        self._torque_delay_ns = round(settings.torque_delay_s * 1e9)
        self._step = self._step_rk4 if settings.integrator == "rk4" else self._step_semi_implicit
        self._opened = False
        self._enabled = False
        self._reset()

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self._model.joints

    @property
    def joint_stops(self) -> JointStops:
        """None are known."""
        return JointStops.none(self.joints)

    def open(self) -> None:
        """Put the arm at its initial position, at rest."""
        if self._opened:
            raise DeviceError("the simulated device is already open; close it first")
        self._reset()
        self._last_ns = self._now_ns()
        self._opened = True

    def enable(self) -> None:
        """Switch the outputs on, at zero torque."""
        self._require_open()
        self._advance(self._now_ns())  # what has passed until here passed with the outputs off
        self._zero_torque()
        self._enabled = True

    def read(self) -> DeviceState:
        """Simulate up to now and return the measured state."""
        self._require_open()
        now_ns = self._now_ns()
        self._advance(now_ns)
        position, velocity = self._measure(now_ns)
        wrench = np.zeros(6)
        if self._contact is not None:
            force_n = self._touch(self._contact, self._session_s(now_ns), self._q, self._q_dot)[0]
            wrench[: len(force_n)] = force_n
        if self._settings.force_noise_n > 0.0:
            z = self._model.task_dimension
            wrench[:z] += self._settings.force_noise_n * self._random.standard_normal(z)
        return DeviceState(position, velocity, wrench, now_ns)

    def write(self, torque_nm: FloatArray) -> None:
        """Hold these joint torques, within the actuator's limit, until others take over.

        They act from the last reading on, or `torque_delay_s` after it.
        """
        if not self._enabled:
            raise DeviceError("torque refused: the outputs are off; call enable() first")
        if torque_nm.shape != (self.joints,):
            raise DeviceError(f"torque refused: shape {torque_nm.shape}, not ({self.joints},)")
        if not all(map(math.isfinite, torque_nm.tolist())):
            raise DeviceError(f"torque refused: {torque_nm} N·m is not finite")
        limit = self._settings.torque_limit_nm
        torque = torque_nm.copy() if limit is None else np.clip(torque_nm, -limit, limit)
        if self._torque_delay_ns > 0:
            self._pending.append((self._last_ns + self._torque_delay_ns, torque))
        else:
            self._torque = torque

    def stop(self) -> None:
        """Zero the torque at once, switch the outputs off and let the brakes fall in."""
        self._enabled = False
        self._zero_torque()
        if self._settings.brakes:
            self._q_dot = np.zeros(self.joints)

    def close(self) -> None:
        """Stop and let go of the arm."""
        self.stop()
        self._opened = False

    def _reset(self) -> None:
        self._q = np.array(self._settings.initial_position_rad)
        self._q_dot = np.zeros(self.joints)
        self._zero_torque()
        self._friction = np.zeros(self.joints)
        self._touched: _Touched | None = None
        self._encoder_rad: FloatArray | None = None
        self._measured_ns = 0
        self._filtered_rad_s = np.zeros(self.joints)
        self._random = np.random.default_rng(self._seed)

    def _zero_torque(self) -> None:
        self._torque = np.zeros(self.joints)
        self._pending: deque[tuple[int, FloatArray]] = deque()  # from when on [ns], torque

    def _require_open(self) -> None:
        if not self._opened:
            raise DeviceError("the simulated device is not open; call open() first")

    def _session_s(self, now_ns: int) -> float:
        return (now_ns - self._session_start_ns) / 1e9

    def _advance(self, now_ns: int) -> None:
        elapsed_ns = now_ns - self._last_ns
        self._last_ns = now_ns
        if elapsed_ns <= 0 or (self._settings.brakes and not self._enabled):
            return
        if elapsed_ns > MAX_CATCH_UP_NS:
            self.skipped_ns += elapsed_ns - MAX_CATCH_UP_NS
            elapsed_ns = MAX_CATCH_UP_NS
        reached_ns = now_ns - elapsed_ns
        while self._pending and self._pending[0][0] < now_ns:
            from_ns, torque = self._pending.popleft()
            if from_ns > reached_ns:
                self._integrate(reached_ns, from_ns)
                reached_ns = from_ns
            self._torque = torque
        self._integrate(reached_ns, now_ns)

    def _integrate(self, start_ns: int, end_ns: int) -> None:
        elapsed_ns = end_ns - start_ns
        steps = -(-elapsed_ns // self._step_ns)
        step_s = elapsed_ns / (steps * 1e9)
        start_s = self._session_s(start_ns)
        for step in range(steps):
            q, q_dot = self._step(start_s + step * step_s, step_s)
            # Written so that a NaN too counts as diverged.
            if not math.hypot(*q_dot.tolist()) < DIVERGED_RAD_S:
                raise DeviceError(
                    f"the simulation diverged at {start_s:.3f} s: joint velocity {q_dot} rad/s is "
                    f"beyond {DIVERGED_RAD_S:g}; lower the gains or step_s "
                    f"(now {self._settings.step_s} s)"
                )
            self._q, self._q_dot = q, q_dot

    def _acceleration(
        self, time_s: float, q: FloatArray, q_dot: FloatArray, torque: FloatArray
    ) -> FloatArray:
        if self._settings.viscous_friction_nm_s > 0.0:
            torque = torque - self._settings.viscous_friction_nm_s * q_dot
        if self._contact is not None:
            torque = torque + self._touch(self._contact, time_s, q, q_dot)[1]
        return self._model.forward_dynamics(q, q_dot, torque)

    def _touch(
        self, contact: ContactForce, time_s: float, q: FloatArray, q_dot: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the contact's force F (z,) and JᵀF (n,).

        Asked again for the same state, as the first step after a reading does, it remembers.
        """
        last = self._touched
        if last is not None and last.q is q and last.q_dot is q_dot and last.time_s == time_s:
            return last.force_n, last.torque_nm
        X, X_dot, J = self._model.end_effector(q, q_dot)
        force_n = contact.force_n(time_s, X, X_dot)
        self._touched = _Touched(time_s, q, q_dot, force_n, torque_nm := J.T.dot(force_n))
        return force_n, torque_nm

    def _step_semi_implicit(self, time_s: float, step_s: float) -> tuple[FloatArray, FloatArray]:
        acceleration = self._acceleration(time_s, self._q, self._q_dot, self._torque)
        if self._settings.coulomb_friction_nm > 0.0:
            acceleration += self._coulomb_friction(acceleration, step_s)[1]
        q_dot = self._q_dot + step_s * acceleration
        return self._q + step_s * q_dot, q_dot

    def _step_rk4(self, time_s: float, step_s: float) -> tuple[FloatArray, FloatArray]:
        q, v, torque = self._q, self._q_dot, self._torque
        a1 = self._acceleration(time_s, q, v, torque)
        if self._settings.coulomb_friction_nm > 0.0:
            friction, change = self._coulomb_friction(a1, step_s)
            a1 += change
            torque = torque + friction
        half_s = 0.5 * step_s
        v2 = v + half_s * a1
        a2 = self._acceleration(time_s + half_s, q + half_s * v, v2, torque)
        v3 = v + half_s * a2
        a3 = self._acceleration(time_s + half_s, q + half_s * v2, v3, torque)
        v4 = v + step_s * a3
        a4 = self._acceleration(time_s + step_s, q + step_s * v3, v4, torque)
        return (
            q + step_s / 6.0 * (v + 2.0 * (v2 + v3) + v4),
            v + step_s / 6.0 * (a1 + 2.0 * (a2 + a3) + a4),
        )

    def _coulomb_friction(
        self, acceleration: FloatArray, step_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the friction torque of one step and the acceleration it adds.

        The torque within ±limit that leaves the least kinetic energy ½vᵀMv after the step, found
        joint by joint (projected Gauss–Seidel). Every sweep lowers that energy, so friction can
        hold a joint still but neither chatter nor drive it.
        """
        limit_nm = self._settings.coulomb_friction_nm
        inverse_inertia = self._model.inverse_inertia(self._q)
        free_velocity = self._q_dot + step_s * acceleration
        # The last step's friction is the best start, unless it would feed energy in now.
        start = self._friction
        if start @ (free_velocity + 0.5 * step_s * (inverse_inertia @ start)) > 0.0:
            start = np.zeros(self.joints)
        # Lists: for a handful of joints, scalar by scalar, they are faster than arrays.
        velocity = (free_velocity + step_s * (inverse_inertia @ start)).tolist()
        friction = start.tolist()
        columns = (step_s * inverse_inertia).tolist()
        for _ in range(FRICTION_SWEEPS):
            largest_change = 0.0
            for joint, column in enumerate(columns):
                stopping = friction[joint] - velocity[joint] / column[joint]
                change = min(max(stopping, -limit_nm), limit_nm) - friction[joint]
                friction[joint] += change
                velocity = [v + change * c for v, c in zip(velocity, column, strict=True)]
                largest_change = max(largest_change, abs(change))
            if largest_change <= 1e-12 * limit_nm:
                break
        self._friction = np.array(friction)
        return self._friction, inverse_inertia @ self._friction

    def _measure(self, now_ns: int) -> tuple[FloatArray, FloatArray]:
        resolution = self._settings.encoder_resolution_rad
        if resolution > 0.0:
            position = np.round(self._q / resolution) * resolution
            if self._encoder_rad is None:
                self._encoder_rad, self._measured_ns = position, now_ns
            elif now_ns > self._measured_ns:
                elapsed_s = (now_ns - self._measured_ns) / 1e9
                difference = (position - self._encoder_rad) / elapsed_s
                weight = elapsed_s / (elapsed_s + self._settings.velocity_filter_s)
                self._filtered_rad_s += weight * (difference - self._filtered_rad_s)
                self._encoder_rad, self._measured_ns = position, now_ns
            position, velocity = position.copy(), self._filtered_rad_s.copy()
        else:
            position, velocity = self._q.copy(), self._q_dot.copy()
        noise = self._settings.velocity_noise_rad_s
        if noise > 0.0:
            velocity += noise * self._random.standard_normal(self.joints)
        return position, velocity


def _create(settings: SimulatedSettings, context: DeviceContext) -> SimulatedDevice:
    return SimulatedDevice(
        context.model,
        settings,
        context.contact,
        context.now_ns,
        context.session_start_ns,
        context.seed,
    )


DRIVER = DriverEntry(settings=SimulatedSettings, create=_create)
