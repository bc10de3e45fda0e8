"""Which way each encoder of a Quanser robot counts, and which way each motor pushes.

An encoder's sign is seen while a person turns its joint; a motor's, while a small current, of
either direction in turn, moves the free arm a little. Counts per radian, gains and torque
constants stay the user's to measure.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np

from hardware.interface import DeviceConfigurationError, DeviceError, FloatArray
from hardware.quanser import QuanserSettings
from hardware.quanser_board import QuanserBoard

POLL_S = 0.001
WATCHDOG_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """How the arm is probed, angles as the encoders count them.

    The current rises to `current_a` within `ramp_s` and stays for as long again; motion of its
    joint by `seen_rad` tells the direction, and motion of any joint by `end_rad` ends everything.
    A hand has to turn a joint by `hand_rad`, within `hand_timeout_s`. The arm rests when no encoder
    has moved by a quarter of `seen_rad` for `rest_s`.
    """

    current_a: float = 0.2
    ramp_s: float = 2.0
    seen_rad: float = 0.01
    end_rad: float = 0.1
    hand_rad: float = 0.1
    hand_timeout_s: float = 60.0
    rest_s: float = 0.3
    rest_timeout_s: float = 10.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not 0.0 < getattr(self, name) < math.inf:
                raise DeviceConfigurationError(f"{name} is {getattr(self, name)}; must be positive")
        if not self.seen_rad <= 0.5 * self.end_rad:
            raise DeviceConfigurationError(
                f"seen_rad is {self.seen_rad}; choose at most half of end_rad = {self.end_rad}"
            )


@dataclass(frozen=True, slots=True)
class JointSigns:
    """What was found at one joint.

    `forward_a` and `backward_a` are the currents at which it moved, and `forward_rad` how far each
    encoder had moved by then under the first: more than one says something of the drive matrix.
    """

    encoder_sign: int
    motor_sign: int
    forward_a: float
    backward_a: float
    forward_rad: tuple[float, ...]


class Commissioning:
    """A board under examination, as a context: amplifiers are off at its end, however it ends.

    `should_stop` is asked every millisecond; `pause` sleeps.
    """

    def __init__(
        self,
        settings: QuanserSettings,
        probe: Probe,
        should_stop: Callable[[], bool],
        now_ns: Callable[[], int],
        pause: Callable[[float], None],
    ) -> None:
        for joint, continuous_a in enumerate(settings.continuous_a):
            if probe.current_a > continuous_a:
                raise DeviceConfigurationError(
                    f"a probe of {probe.current_a} A is above continuous_a[{joint}] = "
                    f"{continuous_a}"
                )
        self.joints = len(settings.encoder_channels)
        self._board = QuanserBoard(settings.wiring)
        self._probe = probe
        self._should_stop = should_stop
        self._now_ns = now_ns
        self._pause = pause
        self._counts_per_rad = np.array(settings.counts_per_rad)
        self._gains = settings.amplifier_gain_a_per_v

    def __enter__(self) -> Self:
        self._board.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._board.make_safe()
        self._board.close()

    def rest(self) -> None:
        """Wait until no encoder has moved for a while; amplifiers are off."""
        probe = self._probe
        held_rad, since_s = self._angles(), 0.0
        for elapsed_s in self._until(probe.rest_timeout_s, "the arm did not come to rest"):
            angles_rad = self._angles()
            if np.abs(angles_rad - held_rad).max() > 0.25 * probe.seen_rad:
                held_rad, since_s = angles_rad, elapsed_s
            if elapsed_s - since_s >= probe.rest_s:
                return

    def encoder_sign(self, joint: int) -> int:
        """Wait for a hand to turn a joint in its positive direction; amplifiers are off."""
        probe = self._probe
        start_rad = self._angles()
        for _ in self._until(probe.hand_timeout_s, f"joint {joint + 1} was not turned"):
            moved_rad = float((self._angles() - start_rad)[joint])
            if abs(moved_rad) >= probe.hand_rad:
                return 1 if moved_rad > 0.0 else -1
        raise AssertionError("the loop above ends by itself")

    def signs(self, joint: int, encoder_sign: int) -> JointSigns:
        """Let a joint's motor move it a little both ways; nobody may touch the arm."""
        forward_rad, forward_a = self._push(joint, 1)
        backward_rad, backward_a = self._push(joint, -1)
        if forward_rad[joint] * backward_rad[joint] > 0.0:
            raise DeviceError(
                f"joint {joint + 1} moved the same way under {forward_a:.3f} A and "
                f"{backward_a:.3f} A: something else pushes it, gravity or a hand"
            )
        direction = 1 if forward_rad[joint] > 0.0 else -1
        return JointSigns(
            encoder_sign,
            direction * encoder_sign,
            forward_a,
            backward_a,
            tuple(forward_rad.tolist()),
        )

    def _push(self, joint: int, direction: int) -> tuple[FloatArray, float]:
        """Ramp a current up until the joint moves; return the motion (n,) and the current."""
        probe = self._probe
        self.rest()
        volts = [0.0] * self.joints
        try:
            self._board.arm(WATCHDOG_S)
            start_rad = self._angles()
            for elapsed_s in self._until(
                2.0 * probe.ramp_s,
                f"joint {joint + 1} did not move under {direction * probe.current_a} A (is its "
                f"amplifier on, its encoder connected, the arm free?)",
            ):
                current_a = direction * probe.current_a * min(elapsed_s / probe.ramp_s, 1.0)
                volts[joint] = current_a / self._gains[joint]
                self._board.write_volts(volts)
                moved_rad = self._angles() - start_rad
                if np.abs(moved_rad).max() > probe.end_rad:
                    raise DeviceError(
                        f"the arm moved by {np.round(moved_rad, 3)} rad under {current_a:.3f} A at "
                        f"joint {joint + 1}, beyond {probe.end_rad} rad: ended"
                    )
                if abs(moved_rad[joint]) >= probe.seen_rad:
                    return moved_rad, current_a
        finally:
            self._board.make_safe()
            self._board.disarm()
        raise AssertionError("the loop above ends by itself")

    def _until(self, timeout_s: float, otherwise: str) -> Iterator[float]:
        """Yield the time passed [s] every millisecond; raises DeviceError when it is up."""
        start_ns = self._now_ns()
        while True:
            if self._should_stop():
                raise DeviceError("ended by hand")
            elapsed_s = (self._now_ns() - start_ns) * 1e-9
            if elapsed_s > timeout_s:
                raise DeviceError(f"{otherwise} within {timeout_s:g} s")
            yield elapsed_s
            self._pause(POLL_S)

    def _angles(self) -> FloatArray:
        angles: FloatArray = self._board.read_counts() / self._counts_per_rad
        return angles


def toml_snippet(found: tuple[JointSigns, ...]) -> str:
    """Return the two lines to paste into the device's table."""
    encoders = ", ".join(str(signs.encoder_sign) for signs in found)
    motors = ", ".join(str(signs.motor_sign) for signs in found)
    return f"encoder_signs = [{encoders}]\nmotor_signs = [{motors}]"
