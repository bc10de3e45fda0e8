"""What every reading and every command passes. Whatever is cut is reported."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag
from math import inf, isfinite

import numpy as np
import numpy.typing as npt

from hardware.interface import DeviceState, JointStops
from hardware.robot_model import RobotTerms

FloatArray = npt.NDArray[np.float64]


class GuardError(Exception):
    """A value that cannot be mended by cutting, or cuts without end: the site goes to FAULT."""


class Cut(IntFlag):
    """What the guard cut in one tick."""

    NONE = 0
    TORQUE = 1
    VELOCITY = 2
    WORKSPACE = 4
    TORQUE_RATE = 8
    KINETIC_ENERGY = 16
    JOINT = 32


_EXCESS = Cut.TORQUE | Cut.VELOCITY | Cut.TORQUE_RATE | Cut.KINETIC_ENERGY
"""Cuts that a sound session makes for moments only; a hand may lean on the others for ever."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Per joint: torque [N·m], its rate [N·m/s], velocity [rad/s], (n,); box [m], (z,); stops.

    Gravity's torque is beyond the rate's limit. Ticks cut for torque, rate, velocity or energy may
    outnumber the others by `fault_after_s`, then it is a fault. inf is no limit.
    """

    torque_nm: FloatArray
    torque_rate_nm_s: FloatArray
    velocity_rad_s: FloatArray
    kinetic_energy_j: float
    workspace_min_m: FloatArray
    workspace_max_m: FloatArray
    stops: JointStops
    fault_after_s: float


class Guard:
    """Limits on the point to follow and on the torque; `cut` tells what this tick lost."""

    def __init__(self, limits: Limits, period_s: float) -> None:
        self._limits = limits
        # Plain numbers: checking a handful of them costs a fraction of an array operation.
        self._box_m = list(
            zip(limits.workspace_min_m.tolist(), limits.workspace_max_m.tolist(), strict=True)
        )
        self._bounds = list(
            zip(limits.torque_nm.tolist(), limits.velocity_rad_s.tolist(), strict=True)
        )
        self._period_s = period_s
        self._largest_step_nm = limits.torque_rate_nm_s * period_s
        self._limits_rate = bool(np.isfinite(limits.torque_rate_nm_s).any())
        self._stops = list(_sides(limits.stops))
        self._excess_s = 0.0
        self._before_nm = np.zeros_like(limits.torque_nm)
        self.cut = Cut.NONE
        self.counts = {cut: 0 for cut in Cut if cut}

    def restart(self) -> None:
        """Begin anew with the outputs: at zero torque but gravity's, no excess counted."""
        self._excess_s = 0.0
        self._before_nm = np.zeros_like(self._before_nm)

    def reading(self, reading: DeviceState) -> None:
        """Let a finite reading pass; raises GuardError on any other, driven or not."""
        self.cut = Cut.NONE
        for name, values in (
            ("joint position", reading.position_rad),
            ("joint velocity", reading.velocity_rad_s),
            ("wrench", reading.wrench),
        ):
            if not _finite(values):
                raise GuardError(f"the device read a {name} of {values}: it is not finite")

    def target(self, position_m: FloatArray) -> FloatArray:
        """Return the nearest point of the workspace box to the peer's point, (z,)."""
        if all(
            low <= x <= high
            for x, (low, high) in zip(position_m.tolist(), self._box_m, strict=True)
        ):
            return position_m
        self._count(Cut.WORKSPACE)
        return np.clip(position_m, self._limits.workspace_min_m, self._limits.workspace_max_m)

    def torque(self, torque_nm: FloatArray, terms: RobotTerms) -> FloatArray:
        """Return a torque within limits, (n,), for a robot in the state of `terms`.

        A joint faster than its limit, an arm with more kinetic energy than its limit, or one at a
        stop keeps its gravity torque but nothing that takes it further. Raises GuardError on a
        non-finite value, and when cuts go on for too long.
        """
        if not _finite(torque_nm):
            raise GuardError(f"commanded torque {torque_nm} N·m is not finite")
        q_dot, gravity_nm = terms.q_dot, terms.G
        limited = torque_nm
        if self._limits_rate:
            limited = self._within_rate(limited - gravity_nm) + gravity_nm
        too_fast = not all(
            abs(torque) <= strongest and abs(speed) <= fastest
            for torque, speed, (strongest, fastest) in zip(
                limited.tolist(), q_dot.tolist(), self._bounds, strict=True
            )
        )
        if too_fast:
            limited = self._within_velocity(limited, q_dot, gravity_nm)
        if self._limits.kinetic_energy_j < inf:
            limited = self._within_energy(limited, terms)
        for inward, bound_rad in self._stops:
            limited = self._within_stop(limited, terms, inward, bound_rad)
        if too_fast or self.cut:
            limited = self._within_strength(limited)
        if self._limits_rate:
            self._before_nm = limited - gravity_nm
        self._tally()
        return limited

    def _within_rate(self, net_nm: FloatArray) -> FloatArray:
        step = self._largest_step_nm
        slow = np.clip(net_nm, self._before_nm - step, self._before_nm + step)
        if (slow != net_nm).any():
            self._count(Cut.TORQUE_RATE)
        return slow

    def _within_velocity(
        self, torque_nm: FloatArray, q_dot: FloatArray, gravity_nm: FloatArray
    ) -> FloatArray:
        speeding_up = (np.abs(q_dot) > self._limits.velocity_rad_s) & (
            (torque_nm - gravity_nm) * q_dot > 0.0
        )
        if not speeding_up.any():
            return torque_nm
        self._count(Cut.VELOCITY)
        return np.where(speeding_up, gravity_nm, torque_nm)

    def _within_energy(self, torque_nm: FloatArray, terms: RobotTerms) -> FloatArray:
        """Above the limit, take away what feeds the motion: ½ q̇ᵀMq̇ rises by no torque of ours."""
        q_dot = terms.q_dot
        power_w = float((torque_nm - terms.G) @ q_dot)
        if power_w <= 0.0 or 0.5 * float(q_dot @ terms.M @ q_dot) <= self._limits.kinetic_energy_j:
            return torque_nm
        self._count(Cut.KINETIC_ENERGY)
        return torque_nm - (power_w / float(q_dot @ q_dot)) * q_dot

    def _within_stop(
        self, torque_nm: FloatArray, terms: RobotTerms, outward: FloatArray, bound_rad: float
    ) -> FloatArray:
        """At or beyond a stop, take away what pushes along `outward`, its row of A."""
        if float(outward @ terms.q) < bound_rad:
            return torque_nm
        push_nm = float((torque_nm - terms.G) @ outward) / float(outward @ outward)
        if push_nm <= 0.0:
            return torque_nm
        self._count(Cut.JOINT)
        return torque_nm - push_nm * outward

    def _within_strength(self, torque_nm: FloatArray) -> FloatArray:
        strongest = self._limits.torque_nm
        if (np.abs(torque_nm) <= strongest).all():
            return torque_nm
        self._count(Cut.TORQUE)
        return np.clip(torque_nm, -strongest, strongest)

    def _tally(self) -> None:
        """Let the excess grow by each tick that was cut, and shrink by each that was not."""
        if not self.cut & _EXCESS:
            if self._excess_s > 0.0:
                self._excess_s = max(0.0, self._excess_s - self._period_s)
            return
        self._excess_s += self._period_s
        if self._excess_s > self._limits.fault_after_s:
            cut = self.cut & _EXCESS
            raise GuardError(
                f"commands were cut for {self._limits.fault_after_s:g} s, the last one by the "
                f"limits of {cut_names(cut)}: the gains or the limits are wrong, or the robot is"
            )

    def _count(self, cut: Cut) -> None:
        self.cut |= cut
        self.counts[cut] += 1


def cut_names(cuts: Cut) -> str:
    """Return the names of these cuts for people."""
    return ", ".join(str(cut.name).lower().replace("_", " ") for cut in cuts)


def _sides(stops: JointStops) -> Iterator[tuple[FloatArray, float]]:
    """Yield each finite bound as (outward row, greatest value along it)."""
    for row, low, high in zip(stops.matrix, stops.lower_rad, stops.upper_rad, strict=True):
        for outward, bound_rad in ((row, high), (-row, -low)):
            if isfinite(bound_rad):
                yield outward, float(bound_rad)


def _finite(values: FloatArray) -> bool:
    """Whether all values are finite: one not finite, or beyond 1e154, spoils the sum of squares."""
    return isfinite(values.dot(values))
