"""Hands for a simulated local robot: none, scripted forces, a human arm."""

from dataclasses import dataclass
from math import cos, hypot, pi, sin

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


def build_operator(settings: OperatorSettings, dimension: int) -> ContactForce | None:
    """Build the operator that a session file describes; None if there is none."""
    match settings:
        case NoOperator():
            return None
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

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        """Return the force (z,) [N], no longer than the hand's limit."""
        settings = self.settings
        grip, _ = smooth_ramp(time_s - settings.start_s, settings.grip_s)
        stiffness, damping = settings.stiffness_n_per_m, settings.damping_n_s_per_m
        force = []
        for x, x_dot, center, amplitude, frequency_hz, phase in zip(
            position_m.tolist(),
            velocity_m_s.tolist(),
            settings.center_m,
            settings.amplitude_m,
            settings.frequency_hz,
            settings.phase_rad,
            strict=True,
        ):
            rate = 2.0 * pi * frequency_hz
            angle = rate * time_s + phase
            behind = center + amplitude * sin(angle) - x
            slower = amplitude * rate * cos(angle) - x_dot
            force.append(grip * (stiffness * behind + damping * slower))
        size = hypot(*force)
        limit = settings.force_limit_n
        return np.array(force) * (1.0 if size <= limit else limit / size)
