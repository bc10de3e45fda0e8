"""Hands for a simulated local robot: none, scripted forces, a human arm."""

from dataclasses import dataclass, field
from math import pi, sin

import numpy as np
import numpy.typing as npt

from control_law.ramp import smooth_ramp
from hardware.interface import ContactForce
from site_runtime.session import (
    ConstantOperator,
    HumanArmOperator,
    NoOperator,
    OperatorSettings,
    Pulse,
    PulsesOperator,
)

FloatArray = npt.NDArray[np.float64]


def build_operator(settings: OperatorSettings, dimension: int) -> ContactForce:
    """Build the operator that a session file describes."""
    match settings:
        case NoOperator():
            return ConstantForce(np.zeros(dimension), 0.0)
        case ConstantOperator():
            return ConstantForce(np.array(settings.force_n), settings.start_s)
        case PulsesOperator():
            return PulsedForce(settings.pulses, dimension)
        case HumanArmOperator():
            return HumanArm(settings)


@dataclass(frozen=True, slots=True)
class ConstantForce:
    """The same force (z,) [N] from `start_s` on."""

    constant_n: FloatArray
    start_s: float

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        """Return the force (z,) [N]."""
        return self.constant_n if time_s >= self.start_s else np.zeros_like(self.constant_n)


@dataclass(frozen=True, slots=True)
class PulsedForce:
    """sin² pulses along the axes; where they overlap they add up."""

    pulses: tuple[Pulse, ...]
    dimension: int

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        """Return the force (z,) [N]."""
        force = np.zeros(self.dimension)
        for pulse in self.pulses:
            if pulse.start_s < time_s < pulse.end_s:
                phase = (time_s - pulse.start_s) / (pulse.end_s - pulse.start_s)
                force["xyz".index(pulse.axis)] += pulse.force_n * sin(pi * phase) ** 2
        return force


@dataclass(frozen=True, slots=True)
class HumanArm:
    """A hand on a path of its own, holding the robot by a spring and a damper of limited force.

    x_j(t) = c_j + a_j sin(2πf_j t + φ_j). The spring–damper takes hold over `grip_s`.
    """

    settings: HumanArmOperator
    _center_m: FloatArray = field(init=False)
    _amplitude_m: FloatArray = field(init=False)
    _rate_rad_s: FloatArray = field(init=False)
    _phase_rad: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_center_m", np.array(self.settings.center_m))
        object.__setattr__(self, "_amplitude_m", np.array(self.settings.amplitude_m))
        object.__setattr__(self, "_rate_rad_s", 2.0 * pi * np.array(self.settings.frequency_hz))
        object.__setattr__(self, "_phase_rad", np.array(self.settings.phase_rad))

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        """Return the force (z,) [N], no longer than the hand's limit."""
        settings = self.settings
        grip, _ = smooth_ramp(time_s - settings.start_s, settings.grip_s)
        if grip == 0.0:
            return np.zeros_like(position_m)
        angle = self._rate_rad_s * time_s + self._phase_rad
        wanted_m = self._center_m + self._amplitude_m * np.sin(angle)
        wanted_m_s = self._amplitude_m * self._rate_rad_s * np.cos(angle)
        force = grip * (
            settings.stiffness_n_per_m * (wanted_m - position_m)
            + settings.damping_n_s_per_m * (wanted_m_s - velocity_m_s)
        )
        size = float(np.sqrt(force @ force))
        return force if size <= settings.force_limit_n else force * (settings.force_limit_n / size)
