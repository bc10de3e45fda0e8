"""Angles and torques of a PHANToM's parallelogram as those of two serial joints.

The motors act on θ2, thigh, and θ3, shin, both absolute in the arm's plane; θ = 0 is a horizontal
thigh and a shin straight down. Serial joints: q1 = θ2 + β1, q2 = θ3 − θ2 − π/2 + β2. A device may
give its third angle relative to the thigh instead; then P = I below.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hardware.interface import FloatArray, JointStops

ThirdAngle = Literal["absolute", "relative"]

# Vendor's link lengths [m], by which HD_CURRENT_POSITION is computed whatever is mounted.
NATIVE_LENGTHS_M = (0.2096, 0.1695)

# Where the mechanism ends, in absolute angles: θ2, θ3, and θ3 − θ2, which the parallelogram limits
# (mahilab/Phantom, validate_angles: θ2 − θ3 ≤ 65°, θ3 − θ2 ≤ 55°).
THIGH_STOPS_RAD = (math.radians(-124.0), math.radians(119.0))
SHIN_STOPS_RAD = (math.radians(-29.0), math.radians(214.0))
BEND_STOPS_RAD = (math.radians(-65.0), math.radians(55.0))

DECIDING_M = 0.008
CLEAR_SHARE = 0.25
TURRET_STILL_RAD = 0.02


@dataclass(frozen=True, slots=True)
class Parallelogram:
    """q = P θ + b and, of equal power, τ_θ = Pᵀ τ_q, for the offsets β (2,) [rad]."""

    offset_rad: tuple[float, float]
    third_angle: ThirdAngle

    def serial_rad(self, thigh_rad: float, shin_rad: float) -> FloatArray:
        """Return q (2,) of the device's angles."""
        q1 = thigh_rad + self.offset_rad[0]
        bend = shin_rad - thigh_rad if self.third_angle == "absolute" else shin_rad
        return np.array([q1, bend - 0.5 * math.pi + self.offset_rad[1]])

    def device_nm(self, torque_nm: FloatArray) -> tuple[float, float]:
        """Return the torques on the device's angles that do what τ_q (2,) does."""
        first, second = float(torque_nm[0]), float(torque_nm[1])
        return (first - second if self.third_angle == "absolute" else first), second

    @property
    def stops(self) -> JointStops:
        """The mechanism's: θ2 is q1, θ3 is q1 + q2 and θ3 − θ2 is q2, each but for a constant."""
        matrix = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        zero_rad = matrix @ self.serial_rad(0.0, 0.0)
        lower_rad, upper_rad = np.transpose([THIGH_STOPS_RAD, SHIN_STOPS_RAD, BEND_STOPS_RAD])
        return JointStops(matrix, zero_rad + lower_rad, zero_rad + upper_rad)


class ThirdAngleCheck:
    """Tells from motion whether the third angle is absolute or relative to the thigh.

    Compares the tip's way since the first pose, as the vendor computes it, with both readings of
    the angles, in height and in distance from the first pose in the horizontal. It decides once
    they are 8 mm apart and the vendor's is within a quarter of that of one of them: link lengths
    known to a few per cent cannot mislead it. The turret has to stand still meanwhile.
    """

    def __init__(self, found: ThirdAngle | None = None) -> None:
        self.found = found
        self._reference: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self._apart_m = 0.0

    def restart(self) -> None:
        """Forget the first pose: the angles are about to jump."""
        self._reference = None

    def add(self, angles_rad: tuple[float, ...], position_mm: tuple[float, ...]) -> None:
        """Take joint angles (3,) and the vendor's position (3,) of one frame."""
        if self.found is not None:
            return
        if self._reference is None or (
            abs(angles_rad[0] - self._reference[0][0]) > TURRET_STILL_RAD
        ):
            self._reference = angles_rad, position_mm
            return
        before_rad, before_mm = self._reference
        x, y, z = (1e-3 * (b - a) for a, b in zip(before_mm, position_mm, strict=True))
        way = (math.hypot(x, z), y)
        absolute = _way_m(_tip_m(before_rad[1:]), _tip_m(angles_rad[1:]))
        relative = _way_m(
            _tip_m((before_rad[1], before_rad[1] + before_rad[2])),
            _tip_m((angles_rad[1], angles_rad[1] + angles_rad[2])),
        )
        self._apart_m = max(self._apart_m, apart := math.dist(absolute, relative))
        if apart >= DECIDING_M:
            if math.dist(way, absolute) <= CLEAR_SHARE * apart:
                self.found = "absolute"
            elif math.dist(way, relative) <= CLEAR_SHARE * apart:
                self.found = "relative"

    @property
    def open_question(self) -> str:
        """Say what to do while nothing is decided."""
        if self._apart_m > 3.0 * DECIDING_M:
            return (
                "the device's position follows from its joint angles neither with an absolute nor "
                "with a relative third angle: calibrate it, keep its base joint still, or set "
                'theta3 = "absolute" or "relative"'
            )
        return (
            "whether the third joint angle is absolute or relative is not known yet: move the arm "
            "by hand, thigh and shin by some centimetres, or set theta3 to what it is"
        )


def _tip_m(angles_rad: tuple[float, ...]) -> tuple[float, float]:
    """Return the tip's distance from the turret's axis and its height, absolute angles [m]."""
    thigh, shin = angles_rad
    l1, l2 = NATIVE_LENGTHS_M
    return (
        l1 * math.cos(thigh) + l2 * math.sin(shin),
        l1 * math.sin(thigh) - l2 * math.cos(shin),
    )


def _way_m(before: tuple[float, float], now: tuple[float, float]) -> tuple[float, float]:
    return abs(now[0] - before[0]), now[1] - before[1]
