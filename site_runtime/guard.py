"""What every reading and every command passes. Whatever is cut is reported."""

from dataclasses import dataclass
from enum import IntFlag
from math import isfinite

import numpy as np
import numpy.typing as npt

from hardware.interface import DeviceState

FloatArray = npt.NDArray[np.float64]


class GuardError(Exception):
    """A value that cannot be mended by cutting: the site goes to FAULT."""


class Cut(IntFlag):
    """What the guard cut in one tick."""

    NONE = 0
    TORQUE = 1
    VELOCITY = 2
    WORKSPACE = 4


@dataclass(frozen=True, slots=True)
class Limits:
    """Per-joint torque [N·m] and velocity [rad/s], (n,); workspace box [m], (z,)."""

    torque_nm: FloatArray
    velocity_rad_s: FloatArray
    workspace_min_m: FloatArray
    workspace_max_m: FloatArray


class Guard:
    """Limits on the point to follow and on the torque; `cut` tells what this tick lost."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        # Plain numbers: checking a handful of them costs a fraction of an array operation.
        self._box_m = list(
            zip(limits.workspace_min_m.tolist(), limits.workspace_max_m.tolist(), strict=True)
        )
        self._bounds = list(
            zip(limits.torque_nm.tolist(), limits.velocity_rad_s.tolist(), strict=True)
        )
        self.cut = Cut.NONE
        self.counts = {Cut.TORQUE: 0, Cut.VELOCITY: 0, Cut.WORKSPACE: 0}

    def reading(self, reading: DeviceState) -> None:
        """Let a finite reading pass; raises GuardError on any other, driven or not."""
        for name, values in (
            ("joint position", reading.position_rad),
            ("joint velocity", reading.velocity_rad_s),
            ("wrench", reading.wrench),
        ):
            if not _finite(values):
                raise GuardError(f"the device read a {name} of {values}: it is not finite")

    def target(self, position_m: FloatArray) -> FloatArray:
        """Return the nearest point of the workspace box to the peer's point, (z,)."""
        self.cut = Cut.NONE
        if all(
            low <= x <= high
            for x, (low, high) in zip(position_m.tolist(), self._box_m, strict=True)
        ):
            return position_m
        self._count(Cut.WORKSPACE)
        return np.clip(position_m, self._limits.workspace_min_m, self._limits.workspace_max_m)

    def torque(
        self, torque_nm: FloatArray, velocity_rad_s: FloatArray, gravity_nm: FloatArray
    ) -> FloatArray:
        """Return a torque within limits, (n,).

        A joint faster than its limit keeps its gravity torque but nothing that speeds it up.
        Raises GuardError on a non-finite value.
        """
        if not _finite(torque_nm):
            raise GuardError(f"commanded torque {torque_nm} N·m is not finite")
        limits = self._limits
        if all(
            abs(torque) <= strongest and abs(speed) <= fastest
            for torque, speed, (strongest, fastest) in zip(
                torque_nm.tolist(), velocity_rad_s.tolist(), self._bounds, strict=True
            )
        ):
            return torque_nm
        limited = torque_nm
        too_fast = np.abs(velocity_rad_s) > limits.velocity_rad_s
        if too_fast.any():
            speeding_up = too_fast & ((torque_nm - gravity_nm) * velocity_rad_s > 0.0)
            if speeding_up.any():
                limited = np.where(speeding_up, gravity_nm, limited)
                self._count(Cut.VELOCITY)
        if (np.abs(limited) > limits.torque_nm).any():
            limited = np.clip(limited, -limits.torque_nm, limits.torque_nm)
            self._count(Cut.TORQUE)
        return limited

    def _count(self, cut: Cut) -> None:
        self.cut |= cut
        self.counts[cut] += 1


def _finite(values: FloatArray) -> bool:
    """Whether all values are finite: one not finite, or beyond 1e154, spoils the sum of squares."""
    return isfinite(values.dot(values))
