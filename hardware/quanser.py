"""A robot on a Quanser data acquisition board: encoders, current amplifiers, a watchdog.

The board's own clock samples the encoders; a thread fetches each sample and keeps the newest, so
`read` never waits for the board. Differences are taken over the board's period, which a computer's
jitter does not touch. Torque goes out at once, in `write`, and nothing else reloads the watchdog:
a site that stalls is one whose motors the board switches off.
"""

import math
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NoReturn

import numpy as np

from hardware.interface import (
    DeviceConfigurationError,
    DeviceError,
    DeviceState,
    FloatArray,
    JointStops,
)
from hardware.quanser_board import (
    OUTPUT_RANGE_V,
    USUAL_MODULE,
    QuanserBoard,
    Wiring,
    missing_module,
)
from hardware.quanser_current_limit import FADE_S, CurrentLimit
from hardware.registry import DeviceContext, DriverEntry

IDLE_STALE_S = 1.0
ZERO_TOLERANCE_RAD = 0.01
CLOCK_DRIFT = 2e-4  # more than the board's clock and the computer's ever differ by
LEAVE_S = 0.02
JOIN_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class QuanserSettings:
    """Settings of the driver "quanser", n joints; what must be measured on the bench is required.

    φ_i = encoder_sign_i · counts_i / counts_per_rad_i, and the robot's q = reference_position_rad
    + drive_matrix φ: the identity if each encoder and motor act between two links, [[1, 0],
    [-1, 1]] if the second acts on the second link's absolute angle. Motor i is given
    motor_sign_i · current_i / amplifier_gain_a_per_v_i volts and pushes φ_i with
    torque_constant_nm_per_a_i · current_i, gear included. `joint_min_rad` and `joint_max_rad`, both
    or neither, are the q where the robot's joints end.
    """

    driver: Literal["quanser"] = "quanser"
    board_type: str
    board_id: str = "0"
    module: str = USUAL_MODULE
    encoder_channels: tuple[int, ...]
    analog_channels: tuple[int, ...]
    enable_channels: tuple[int, ...]
    enabled_level: Literal[0, 1] = 1
    counts_per_rad: tuple[float, ...]
    encoder_signs: tuple[int, ...]
    motor_signs: tuple[int, ...]
    amplifier_gain_a_per_v: tuple[float, ...]
    torque_constant_nm_per_a: tuple[float, ...]
    drive_matrix: tuple[tuple[float, ...], ...]
    reference_position_rad: tuple[float, ...]
    joint_min_rad: tuple[float, ...] | None = None
    joint_max_rad: tuple[float, ...] | None = None
    zero_at_open: bool = True
    peak_a: tuple[float, ...]
    continuous_a: tuple[float, ...]
    thermal_time_s: tuple[float, ...]
    sample_rate_hz: int = 1000
    velocity_filter_s: float = 0.0038
    implausible_rad_s: float = 100.0
    torque_ramp_s: float = 0.5
    watchdog_s: float = 0.02

    def __post_init__(self) -> None:
        n = len(self.encoder_channels)
        for name in (
            "encoder_channels",
            "analog_channels",
            "counts_per_rad",
            "encoder_signs",
            "motor_signs",
            "amplifier_gain_a_per_v",
            "torque_constant_nm_per_a",
            "drive_matrix",
            "reference_position_rad",
            "peak_a",
            "continuous_a",
            "thermal_time_s",
        ):
            count = len(getattr(self, name))
            if count != n or n == 0:
                raise DeviceConfigurationError(
                    f"{name} has {count} items, encoder_channels has {n}; one per joint is needed"
                )
        for name in ("encoder_channels", "analog_channels", "enable_channels"):
            channels = getattr(self, name)
            if len(set(channels)) < len(channels) or not all(0 <= c < 1000 for c in channels):
                raise DeviceConfigurationError(
                    f"{name} is {channels}; channels are whole numbers from 0, no two alike"
                )
        if not self.enable_channels:
            raise DeviceConfigurationError(
                "enable_channels is empty; amplifiers that cannot be switched off are not driven"
            )
        for name in ("encoder_signs", "motor_signs"):
            if not all(sign in (-1, 1) for sign in getattr(self, name)):
                raise DeviceConfigurationError(f"{name} is {getattr(self, name)}; 1 or -1 each")
        for name in (
            "counts_per_rad",
            "amplifier_gain_a_per_v",
            "torque_constant_nm_per_a",
            "continuous_a",
            "thermal_time_s",
        ):
            if not all(0.0 < value < math.inf for value in getattr(self, name)):
                raise DeviceConfigurationError(
                    f"{name} is {getattr(self, name)}; every item must be positive"
                )
        for joint, (peak_a, continuous_a, gain) in enumerate(
            zip(self.peak_a, self.continuous_a, self.amplifier_gain_a_per_v, strict=True)
        ):
            most_a = OUTPUT_RANGE_V * gain
            if not continuous_a <= peak_a <= most_a:
                raise DeviceConfigurationError(
                    f"peak_a[{joint}] is {peak_a}; choose between continuous_a = {continuous_a} "
                    f"and {most_a:g}, what {OUTPUT_RANGE_V:g} V make of {gain} A/V"
                )
        if not all(math.isfinite(angle) for angle in self.reference_position_rad):
            raise DeviceConfigurationError(
                f"reference_position_rad is {self.reference_position_rad}; must be finite"
            )
        self._check_drive_matrix(n)
        self._check_joint_range(n)
        for name, low, high in (
            ("sample_rate_hz", 100, 10_000),
            ("velocity_filter_s", 0.0, 1.0),
            ("implausible_rad_s", 1.0, 10_000.0),
            ("torque_ramp_s", 0.0, 60.0),
            ("watchdog_s", 0.003, FADE_S),
        ):
            if not low <= getattr(self, name) <= high:
                raise DeviceConfigurationError(
                    f"{name} is {getattr(self, name)}; choose between {low:g} and {high:g}"
                )

    def _check_drive_matrix(self, n: int) -> None:
        rows = self.drive_matrix
        if any(len(row) != n for row in rows) or not np.isfinite(rows).all():
            raise DeviceConfigurationError(
                f"drive_matrix is {rows}; it needs {n} rows of {n} finite numbers"
            )
        if np.linalg.cond(np.array(rows)) > 1e3:
            raise DeviceConfigurationError(
                f"drive_matrix is {rows}; each of q and φ must tell the other"
            )

    def _check_joint_range(self, n: int) -> None:
        low, high = self.joint_min_rad, self.joint_max_rad
        if low is None and high is None:
            return
        if low is None or high is None:
            raise DeviceConfigurationError(
                f"joint_min_rad is {low}, joint_max_rad is {high}; give both, or neither"
            )
        for name, bounds in (("joint_min_rad", low), ("joint_max_rad", high)):
            if len(bounds) != n or not all(math.isfinite(bound) for bound in bounds):
                raise DeviceConfigurationError(f"{name} is {bounds}; {n} finite angles are needed")
        for joint, (least, reference, most) in enumerate(
            zip(low, self.reference_position_rad, high, strict=True)
        ):
            if not (least < most and least <= reference <= most):
                raise DeviceConfigurationError(
                    f"joint_min_rad[{joint}] is {least}, joint_max_rad[{joint}] is {most}; the "
                    f"first must be the smaller, and reference_position_rad, {reference}, between"
                )

    @property
    def difference_filter_s(self) -> float | None:
        """Time constant of the filter on differenced velocities [s]."""
        return self.velocity_filter_s

    @property
    def wiring(self) -> Wiring:
        """Which board, and what is connected where."""
        return Wiring(
            self.module,
            self.board_type,
            self.board_id,
            self.encoder_channels,
            self.analog_channels,
            self.enable_channels,
            self.enabled_level,
        )


class QuanserDevice:
    """A robot on a Quanser board; a `Device`.

    It must be in the reference pose while it is opened, or keep its counts since it was
    (`zero_at_open`). A vendor's error, an expired watchdog, an implausible jump of an encoder and
    samples that stay away (for `watchdog_s` while enabled) latch: outputs are off, and only close
    and open lead on.
    """

    def __init__(self, settings: QuanserSettings, now_ns: Callable[[], int]) -> None:
        self._settings = settings
        self._now_ns = now_ns
        self._joints = len(settings.encoder_channels)
        self._board = QuanserBoard(settings.wiring)
        self._samples: _Samples | None = None
        self._fault: str | None = None
        self._enabled = False
        self._enabled_ns = 0
        self._limited_ns = 0
        self._was_stale = False
        self._drive = np.array(settings.drive_matrix)
        self._reference_rad = np.array(settings.reference_position_rad)
        self._a_per_nm = self._drive.T / np.array(settings.torque_constant_nm_per_a)[:, None]
        self._v_per_a = [
            sign / gain
            for sign, gain in zip(
                settings.motor_signs, settings.amplifier_gain_a_per_v, strict=True
            )
        ]
        self._limits = [
            CurrentLimit(*values)
            for values in zip(
                settings.peak_a, settings.continuous_a, settings.thermal_time_s, strict=True
            )
        ]

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self._joints

    @property
    def joint_stops(self) -> JointStops:
        """Those of the settings."""
        low, high = self._settings.joint_min_rad, self._settings.joint_max_rad
        if low is None or high is None:
            return JointStops.none(self._joints)
        return JointStops(np.eye(self._joints), np.array(low), np.array(high))

    def open(self) -> None:
        """Connect to the board, outputs off, and start sampling; zero the encoders if asked to."""
        if self._samples is not None:
            raise DeviceError("the Quanser device is already open; close it first")
        settings = self._settings
        self._board.open()
        try:
            if settings.zero_at_open:
                self._board.zero_counts()
            samples = _Samples(self._board, settings, self._now_ns)
            angles = np.abs(samples.newest.angle_rad)
            if settings.zero_at_open and angles.max() > ZERO_TOLERANCE_RAD:
                raise DeviceError(
                    f"the Quanser device moves while its encoders are zeroed, or they do not take "
                    f"it: {angles} rad from zero; hold it in the reference pose"
                )
            self._board.start_sampling(settings.sample_rate_hz)
            samples.start()
        except Exception:
            self._board.make_safe()
            self._board.close()
            raise
        self._samples, self._fault, self._was_stale = samples, None, False

    def enable(self) -> None:
        """Switch the amplifiers on at zero current; the torque ramps in from there."""
        self._newest()
        try:
            if self._enabled:
                self._board.write_volts([0.0] * self._joints)
            else:
                self._board.arm(self._settings.watchdog_s)
        except DeviceError as error:
            self._fail(str(error))
        self._flow([0.0] * self._joints)
        self._enabled, self._enabled_ns = True, self._limited_ns

    def read(self) -> DeviceState:
        """Return the newest sample; its stamp is when the board took it."""
        sample = self._newest()
        return DeviceState(
            self._reference_rad + self._drive @ sample.angle_rad,
            self._drive @ sample.velocity_rad_s,
            np.zeros(6),
            sample.stamp_ns,
        )

    def write(self, torque_nm: FloatArray) -> None:
        """Command joint torques (n,) [N·m], ramped in after `enable`, within the current limits."""
        if not self._enabled:
            if self._fault is not None:
                self._fail(self._fault)
            raise DeviceError("torque refused: the outputs are off; call enable() first")
        if torque_nm.shape != (self._joints,):
            raise DeviceError(f"torque refused: shape {torque_nm.shape}, not ({self._joints},)")
        if not np.isfinite(torque_nm).all():
            raise DeviceError(f"torque refused: {torque_nm} N·m is not finite")
        wanted_a = self._a_per_nm @ torque_nm
        ramp_s = self._settings.torque_ramp_s
        enabled_s = (self._now_ns() - self._enabled_ns) * 1e-9
        if enabled_s < ramp_s:
            wanted_a *= enabled_s / ramp_s
        currents_a = self._flow(wanted_a.tolist())
        volts = [a * v_per_a for a, v_per_a in zip(currents_a, self._v_per_a, strict=True)]
        try:
            self._board.write_volts(volts)
        except DeviceError as error:
            self._fail(str(error))

    def stop(self) -> None:
        """Set the outputs to 0 V, switch the amplifiers off, stop the watchdog."""
        self._quiet()
        self._board.disarm()

    def close(self) -> None:
        """Stop, end sampling, disconnect."""
        self._quiet()
        samples, self._samples = self._samples, None
        if samples is not None:
            samples.leave()
            self._board.stop_sampling(samples.has_left)
        self._board.close()

    def _newest(self) -> "_Sample":
        """Return the newest sample of a sound device; raises DeviceError, and latches."""
        samples = self._samples
        if samples is None:
            raise DeviceError("the Quanser device is not open; call open() first")
        if self._fault is not None:
            self._fail(self._fault)
        if samples.failure is not None:
            self._fail(samples.failure)
        sample = samples.newest
        age_s = (self._now_ns() - sample.stamp_ns) * 1e-9
        stale = age_s > (self._settings.watchdog_s if self._enabled else IDLE_STALE_S)
        # Twice: after a stall of the whole process the thread may not have had its turn yet.
        if stale and self._was_stale:
            self._fail(f"the Quanser board has sent no sample for {age_s:.3f} s")
        self._was_stale = stale
        return sample

    def _flow(self, wanted_a: list[float]) -> list[float]:
        """Return the currents that may flow from now on [A]."""
        now_ns = self._now_ns()
        elapsed_s, self._limited_ns = (now_ns - self._limited_ns) * 1e-9, now_ns
        for limit in self._limits:
            limit.pass_time(elapsed_s)
        return [limit.apply(a) for limit, a in zip(self._limits, wanted_a, strict=True)]

    def _quiet(self) -> None:
        self._enabled = False
        self._board.make_safe()
        self._flow([0.0] * self._joints)

    def _fail(self, reason: str) -> NoReturn:
        if self._fault is None:
            self._fault = reason
            self.stop()
        raise DeviceError(
            f"{self._fault}; the device stays off until it is closed and opened again"
        )


@dataclass(frozen=True, slots=True)
class _Sample:
    """φ (n,), its filtered difference (n,), and when the board took it."""

    angle_rad: FloatArray
    velocity_rad_s: FloatArray
    stamp_ns: int


class _Samples:
    """The thread that fetches every sample of the board; `newest` is the last, `failure` the end.

    A sample's stamp is its number times the board's period, counted from where the promptest
    arrivals put the first: a late fetch makes no sample look younger than it is.
    """

    def __init__(
        self, board: QuanserBoard, settings: QuanserSettings, now_ns: Callable[[], int]
    ) -> None:
        self.failure: str | None = None
        self._board = board
        self._now_ns = now_ns
        self._period_s = 1.0 / settings.sample_rate_hz
        self._weight = self._period_s / (self._period_s + settings.velocity_filter_s)
        self._rad_per_count = np.array(settings.encoder_signs) / np.array(settings.counts_per_rad)
        self._most_rad = settings.implausible_rad_s * self._period_s
        angle_rad = board.read_counts() * self._rad_per_count
        self.newest = _Sample(angle_rad, np.zeros(len(angle_rad)), now_ns())
        self._leaving = False
        self._thread = threading.Thread(target=self._run, name="quanser samples", daemon=True)
        self._scheduling = os.sched_getscheduler(0), os.sched_getparam(0)

    def start(self) -> None:
        """Start fetching."""
        self._thread.start()

    def leave(self) -> None:
        """Let the thread end after the sample it waits for."""
        self._leaving = True
        self._thread.join(2.0 * self._period_s + LEAVE_S)

    def has_left(self) -> bool:
        """Wait for the thread's end; False if it does not come."""
        self._thread.join(JOIN_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        with suppress(OSError):  # a site's real-time class is not inherited by its threads
            os.sched_setscheduler(0, *self._scheduling)
        try:
            self._fetch()
        except Exception as error:
            self.failure = str(error)

    def _fetch(self) -> None:
        period_ns = self._period_s * 1e9
        drift_ns = period_ns * CLOCK_DRIFT
        first_ns = math.inf  # sample 0, on the computer's clock
        before, number = self.newest, 0
        while not self._leaving:
            angle_rad = self._board.next_counts() * self._rad_per_count
            first_ns = min(first_ns + drift_ns, self._now_ns() - number * period_ns)
            step_rad = angle_rad - before.angle_rad
            if np.abs(step_rad).max() > self._most_rad:
                raise DeviceError(
                    f"the Quanser board's encoders jumped by {step_rad} rad in one sample of "
                    f"{self._period_s:g} s"
                )
            velocity = before.velocity_rad_s
            if number > 0:  # the sample before the first was not one period earlier
                velocity = velocity + self._weight * (step_rad / self._period_s - velocity)
            stamp_ns = round(first_ns + number * period_ns)
            self.newest = before = _Sample(angle_rad, velocity, stamp_ns)
            number += 1


def _create(settings: QuanserSettings, context: DeviceContext) -> QuanserDevice:
    return QuanserDevice(settings, context.now_ns)


def _missing(settings: QuanserSettings | None) -> str | None:
    return missing_module(USUAL_MODULE if settings is None else settings.module)


DRIVER = DriverEntry(settings=QuanserSettings, create=_create, missing=_missing)
