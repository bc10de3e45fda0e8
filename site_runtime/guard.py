"""What every reading and every command passes. Whatever is cut is reported."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag
from math import inf, isfinite, sqrt

import numpy as np
import numpy.typing as npt

from hardware.interface import DeviceState, JointStops
from hardware.robot_model import RobotTerms
from site_runtime.half_spaces import nearest_not_along

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


Forbidden = tuple[Cut, FloatArray]

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
        self._strongest_nm = limits.torque_nm.tolist()
        self._fastest_rad_s = limits.velocity_rad_s.tolist()
        self._axes = np.eye(len(self._fastest_rad_s))
        self._largest_step_nm = limits.torque_rate_nm_s * period_s
        self._limits_rate = bool(np.isfinite(limits.torque_rate_nm_s).any())
        self._stops = list(_sides(limits.stops))
        # a part of a tick more, for what rounding takes
        self._most_excess_ticks = limits.fault_after_s / period_s + 1e-6
        self._excess_ticks = 0
        self._before_nm = np.zeros_like(limits.torque_nm)
        self.cut = Cut.NONE
        self.counts = {cut: 0 for cut in Cut if cut}

    def restart(self) -> None:
        """Begin anew with the outputs: at zero torque but gravity's, no excess counted."""
        self._excess_ticks = 0
        self._before_nm = np.zeros_like(self._before_nm)

    def reading(self, reading: DeviceState) -> None:
        """Let a finite reading pass; raises GuardError on any other, driven or not."""
        self.cut = Cut.NONE
        q, q_dot, wrench = reading.position_rad, reading.velocity_rad_s, reading.wrench
        if isfinite(q.dot(q) + q_dot.dot(q_dot) + wrench.dot(wrench)):
            return
        for name, values in (
            ("joint position", q),
            ("joint velocity", q_dot),
            ("wrench", wrench),
        ):
            if not _finite(values):
                raise GuardError(f"the device read a {name} of {values}: it is not finite")

    def target(self, position_m: FloatArray) -> FloatArray:
        """Return the nearest point of the workspace box to the peer's point, (z,)."""
        for x, (low, high) in zip(position_m.tolist(), self._box_m, strict=True):
            if not low <= x <= high:
                break
        else:
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
        limited = torque_nm
        if self._limits_rate:
            limited = self._within_rate(limited, terms.G)
        forbidden = self._forbidden(terms)
        if forbidden:
            limited = self._not_along(forbidden, limited, terms.G)
        limited = self._within_strength(limited, forbidden, terms.G)
        if self._limits_rate:
            self._before_nm = limited - terms.G
        self._tally()
        return limited

    def _within_rate(self, torque_nm: FloatArray, gravity_nm: FloatArray) -> FloatArray:
        net_nm, step_nm = torque_nm - gravity_nm, self._largest_step_nm
        slow_nm = np.clip(net_nm, self._before_nm - step_nm, self._before_nm + step_nm)
        if (slow_nm == net_nm).all():
            return torque_nm
        self._count(Cut.TORQUE_RATE)
        return gravity_nm + slow_nm

    def _forbidden(self, terms: RobotTerms) -> list[Forbidden]:
        """Return along which directions, of length 1, no torque but gravity's may act now."""
        limits, q_dot = self._limits, terms.q_dot
        found: list[Forbidden] = []
        for joint, speed in enumerate(q_dot.tolist()):
            fastest = self._fastest_rad_s[joint]
            if not -fastest <= speed <= fastest:
                axis = self._axes[joint]
                found.append((Cut.VELOCITY, axis if speed > 0.0 else -axis))
        if (
            limits.kinetic_energy_j < inf
            and 0.5 * q_dot.dot(terms.M).dot(q_dot) > limits.kinetic_energy_j
        ):
            found.append((Cut.KINETIC_ENERGY, q_dot / sqrt(q_dot @ q_dot)))
        for outward, bound_rad in self._stops:
            if outward.dot(terms.q) >= bound_rad:
                found.append((Cut.JOINT, outward))
        return found

    def _not_along(
        self, forbidden: list[Forbidden], torque_nm: FloatArray, gravity_nm: FloatArray
    ) -> FloatArray:
        """Take away, all at once, what acts along the forbidden directions."""
        net_nm = torque_nm - gravity_nm
        cut = Cut.NONE
        for limit, direction in forbidden:
            if float(direction @ net_nm) > 0.0:
                cut |= limit
        if not cut:
            return torque_nm
        self._count(cut)
        free_nm = nearest_not_along(net_nm, np.array([direction for _, direction in forbidden]))
        # what is left alone is left as it was, without rounding
        return np.where(free_nm == net_nm, torque_nm, gravity_nm + free_nm)

    def _within_strength(
        self, torque_nm: FloatArray, forbidden: list[Forbidden], gravity_nm: FloatArray
    ) -> FloatArray:
        """Cut joint by joint; but all alike where one joint's cut would leave another's unheld."""
        for torque, strongest in zip(torque_nm.tolist(), self._strongest_nm, strict=True):
            if not -strongest <= torque <= strongest:
                break
        else:
            return torque_nm
        self._count(Cut.TORQUE)
        strongest_nm = self._limits.torque_nm
        cut_nm = np.clip(torque_nm, -strongest_nm, strongest_nm)
        net_nm = cut_nm - gravity_nm
        if all(float(direction @ net_nm) <= 0.0 for _, direction in forbidden):
            return cut_nm
        net_nm = torque_nm - gravity_nm
        room_nm = np.maximum(strongest_nm - np.copysign(1.0, net_nm) * gravity_nm, 0.0)
        share = min(
            (
                room / abs(net)
                for room, net in zip(room_nm.tolist(), net_nm.tolist(), strict=True)
                if abs(net) > room
            ),
            default=1.0,
        )
        all_alike_nm: FloatArray = np.clip(gravity_nm + share * net_nm, -strongest_nm, strongest_nm)
        return all_alike_nm

    def _tally(self) -> None:
        """Let the excess grow by each tick that was cut, and shrink by each that was not."""
        # flags are slow to compare, and most ticks have none
        if self.cut is Cut.NONE or not self.cut & _EXCESS:
            if self._excess_ticks:
                self._excess_ticks -= 1
            return
        self._excess_ticks += 1
        if self._excess_ticks > self._most_excess_ticks:
            cut = self.cut & _EXCESS
            raise GuardError(
                f"commands were cut for {self._limits.fault_after_s:g} s, the last one by the "
                f"limits of {cut_names(cut)}: the gains or the limits are wrong, or the robot is"
            )

    def _count(self, cuts: Cut) -> None:
        self.cut |= cuts
        for cut in cuts:
            self.counts[cut] += 1


def cut_names(cuts: Cut) -> str:
    """Return the names of these cuts for people."""
    return ", ".join(str(cut.name).lower().replace("_", " ") for cut in cuts)


def _sides(stops: JointStops) -> Iterator[tuple[FloatArray, float]]:
    """Yield each finite bound as (outward row of length 1, greatest value along it)."""
    for row, low, high in zip(stops.matrix, stops.lower_rad, stops.upper_rad, strict=True):
        length = float(np.linalg.norm(row))
        for outward, bound_rad in ((row, high), (-row, -low)):
            if isfinite(bound_rad):
                yield outward / length, float(bound_rad) / length


def _finite(values: FloatArray) -> bool:
    """Whether all values are finite: one not finite, or beyond 1e154, spoils the sum of squares."""
    return isfinite(values.dot(values))
